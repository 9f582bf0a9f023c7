import io
import os
import signal
import threading
import time

import pytest

from softfin.rig.stop import SIGNALS, Keyboard, StopRequest, stopped_by_signals


def test_the_first_reason_counts():
    request = StopRequest()
    request.ask("emergency_stop", "by a key")
    request.ask("other", "later")
    assert request.trip == ("emergency_stop", "by a key")


@pytest.mark.parametrize("name", SIGNALS)
def test_a_signal_raises_the_flag_and_no_exception(name):
    request = StopRequest()
    before = signal.getsignal(getattr(signal, name))
    with stopped_by_signals(request):
        os.kill(os.getpid(), getattr(signal, name))
        time.sleep(0.01)
    assert request.trip.reason == ("stopped by Ctrl-C" if name == "SIGINT" else f"stopped by {name}")
    assert signal.getsignal(getattr(signal, name)) is before


def test_an_impatient_second_ctrl_c_does_not_disturb_the_stop_and_a_later_one_ends_the_program(monkeypatch):
    request = StopRequest()
    monkeypatch.setattr("softfin.rig.stop.PATIENCE_S", 0.2)
    with stopped_by_signals(request):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert request.trip is not None
        time.sleep(0.25)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_outside_the_main_thread_signals_stay_as_they_are():
    before = signal.getsignal(signal.SIGINT)
    inside = []

    def work():
        with stopped_by_signals(StopRequest()):
            inside.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join(5)
    assert inside == [before]


def listened(text: str) -> tuple[StopRequest, list[str]]:
    request, lines = StopRequest(), []
    keyboard = Keyboard(request, lines.append, io.StringIO(text))
    keyboard.start()
    keyboard._thread.join(5)
    assert not keyboard._thread.is_alive()
    return request, lines


def test_enter_alone_says_stop_and_other_lines_are_handed_on():
    request, lines = listened("2,-1\n  \n1,1\n")
    assert request.trip == ("emergency_stop", "stopped by a key")
    assert lines == ["2,-1", "1,1"]


def test_a_terminal_that_is_gone_says_nothing():
    request, _ = listened("")
    assert request.trip is None
    closed = io.StringIO("x")
    closed.close()
    keyboard = Keyboard(request, print, closed)
    keyboard.start()
    keyboard._thread.join(5)
    assert not keyboard._thread.is_alive()


def test_what_cannot_be_taken_does_not_end_the_listening():
    request = StopRequest()
    keyboard = Keyboard(request, float, io.StringIO("two\n\n"))
    keyboard.start()
    keyboard._thread.join(5)
    assert request.trip is not None
