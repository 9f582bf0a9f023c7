import ctypes
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.rig.stop import (
    STOP_SIGNALS,
    StopRequest,
    Watchdog,
    interrupted_by_signals,
    listen_to_keyboard,
    stopped_by_signals,
    undisturbed_after_stop,
)
from tests.patience import HANG_S, wait_until


def test_the_first_reason_counts():
    request = StopRequest()
    request.ask("emergency_stop", "by a key")
    request.ask("other", "later")
    assert request.trip == ("emergency_stop", "by a key")


@contextmanager
def handled_by(number, handler):
    """Whoever runs the tests may have changed the handlers: nohup ignores SIGHUP."""
    before = signal.signal(number, handler)
    try:
        yield handler
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_a_signal_raises_the_flag_and_no_exception(name):
    request = StopRequest()
    number = getattr(signal, name)
    with handled_by(
        number, signal.default_int_handler if name == "SIGINT" else signal.SIG_DFL
    ) as before:
        with stopped_by_signals(request):
            os.kill(os.getpid(), number)
            wait_until(lambda: request.trip is not None)
        assert signal.getsignal(number) is before
    assert request.trip.reason == (
        "stopped by Ctrl-C" if name == "SIGINT" else f"stopped by {name}"
    )


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_of_ignored_signals_the_hangup_alone_stays_ignored(name):
    request = StopRequest()
    number = getattr(signal, name)
    with handled_by(number, signal.SIG_IGN):
        with stopped_by_signals(request):
            signal.raise_signal(number)
        assert signal.getsignal(number) is signal.SIG_IGN
    assert (request.trip is None) == (name == "SIGHUP")


def test_an_impatient_second_ctrl_c_does_not_disturb_the_stop_and_a_later_one_ends_the_program(
    monkeypatch,
):
    request = StopRequest()
    monkeypatch.setattr("softfin.rig.stop.PATIENCE_S", HANG_S)
    with stopped_by_signals(request):
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(os.getpid(), signal.SIGINT)
        assert request.trip is not None
        monkeypatch.setattr("softfin.rig.stop.PATIENCE_S", 0.0)
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
    thread.join(HANG_S)
    assert inside == [before]


def listened(text, on_line=None) -> tuple[StopRequest, list[str]]:
    request = StopRequest()
    lines = []
    stream = io.StringIO(text) if isinstance(text, str) else text
    thread = listen_to_keyboard(request, on_line or lines.append, stream)
    thread.join(HANG_S)
    assert not thread.is_alive()
    return request, lines


def test_enter_alone_asks_for_a_stop_and_other_lines_are_handed_on():
    request, lines = listened("2,-1\n  \n1,1\n")
    assert request.trip == ("emergency_stop", "stopped by a key")
    assert lines == ["2,-1", "1,1"]


def test_a_terminal_that_is_gone_asks_for_nothing():
    closed = io.StringIO("x")
    closed.close()
    for stream in ("", closed):
        assert listened(stream)[0].trip is None


def test_a_line_that_cannot_be_used_does_not_end_the_listening():
    assert listened("two\n\n", float)[0].trip is not None


def silences_seen(
    clock: SimulatedClock, use: Callable[[Watchdog], None]
) -> list[tuple[float, float]]:
    """When a watchdog with a patience of 0.2 s called, and the silences it gave [s]."""
    calls = []
    began = clock()
    dog = Watchdog(0.2, lambda silence: calls.append((clock() - began, silence)), clock)
    use(dog)
    clock.sleep(2.0)
    return calls


def test_a_watchdog_calls_once_and_no_later_than_a_quarter_beyond_its_patience():
    clock = SimulatedClock()
    ((at, silence),) = silences_seen(clock, lambda dog: None)
    assert at == silence
    assert 0.2 <= silence <= 0.25 + 1e-6


def test_a_watchdog_counts_from_the_last_sign_of_life():
    clock = SimulatedClock()

    def feed(dog):
        for _ in range(10):
            clock.sleep(0.1)
            dog.feed(clock())

    ((at, silence),) = silences_seen(clock, feed)
    assert at == pytest.approx(1.0 + silence)
    assert 0.2 <= silence <= 0.25 + 1e-6


def test_a_watchdog_that_was_ended_does_not_call():
    assert silences_seen(SimulatedClock(), Watchdog.end) == []


SILENCE_S = 0.15


def test_a_hang_that_holds_the_interpreters_lock_is_seen_only_when_it_is_over():
    during, silence = _hang()
    while during is None:
        during, silence = _hang()
    assert during == []
    assert silence >= SILENCE_S


def _hang():
    """Hold the lock; returns the silences reported meanwhile and the first one. The former are None
    if the computer itself was busy before, so that the watchdog had a reason to report."""
    bitten = threading.Event()
    silences = []

    def bite(silence: float) -> None:
        silences.append(silence)
        bitten.set()

    dog = Watchdog(0.05, bite)
    interval = sys.getswitchinterval()
    # Nothing but the call could let the watchdog's thread run.
    sys.setswitchinterval(60)
    try:
        fed = time.monotonic()
        dog.feed(fed)
        library = ctypes.PyDLL(None)
        called = time.monotonic()
        library.usleep(round(SILENCE_S * 1e6))
        during = list(silences)
    finally:
        sys.setswitchinterval(interval)
    assert bitten.wait(HANG_S)
    return during if called - fed < 0.05 else None, silences[0]


def test_no_signal_breaks_off_a_stop_that_is_under_way(monkeypatch):
    request = StopRequest()
    monkeypatch.setattr("softfin.rig.stop.PATIENCE_S", -1.0)
    with handled_by(signal.SIGINT, signal.default_int_handler), stopped_by_signals(request):
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        request.is_obeyed = True
        signal.raise_signal(signal.SIGINT)
    assert request.trip.reason == "stopped by Ctrl-C"


def test_signals_are_ignored_only_while_a_safety_stop_is_handled():
    with handled_by(signal.SIGINT, signal.default_int_handler) as before:
        with undisturbed_after_stop():
            try:
                raise SafetyStop("stopped")
            except SafetyStop:
                signal.raise_signal(signal.SIGINT)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
        assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_a_signal_interrupts_what_powers_a_motor_and_a_second_one_does_not_disturb_its_end(name):
    number = getattr(signal, name)
    ends = []

    def power() -> None:
        try:
            signal.raise_signal(number)
        finally:
            signal.raise_signal(number)
            ends.append(number)

    with (
        handled_by(number, signal.SIG_DFL),
        interrupted_by_signals(),
        pytest.raises(KeyboardInterrupt),
    ):
        power()
    assert ends == [number]
