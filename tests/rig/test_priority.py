import os
import threading

import pytest

from softfin.core.clock import REAL
from softfin.emulation.clock import SimulatedClock
from softfin.rig.priority import LOOP, NORMAL, WATCHDOG, set_loop_priority, set_priority
from tests.rig.test_session import Made

needs_scheduler = pytest.mark.skipif(
    not hasattr(os, "SCHED_RESET_ON_FORK"), reason="this system has no real-time priority"
)


def in_a_thread(work):
    """What a function returns in a thread of its own, which ends with its priority."""
    found = []
    thread = threading.Thread(target=lambda: found.append(work()))
    thread.start()
    thread.join()
    return found[0]


@needs_scheduler
def test_the_priority_is_that_of_the_thread_alone_and_can_be_taken_back(monkeypatch):
    calls = []
    monkeypatch.setattr(os, "sched_setscheduler", lambda *words: calls.append(words))
    assert set_priority(LOOP, REAL)
    assert set_priority(NORMAL, REAL)
    (loop, normal) = calls
    # 0 is the calling thread; threads and processes that it starts are normal.
    assert loop[:2] == (0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK)
    assert loop[2].sched_priority == LOOP
    assert normal[:2] == (0, os.SCHED_OTHER | os.SCHED_RESET_ON_FORK)
    assert normal[2].sched_priority == 0


@needs_scheduler
def test_the_system_takes_it_or_refuses():
    def work():
        before = os.sched_getscheduler(0)
        allowed = set_priority(LOOP, REAL)
        return allowed, before, os.sched_getscheduler(0)

    allowed, before, during = in_a_thread(work)
    expected = os.SCHED_FIFO | os.SCHED_RESET_ON_FORK if allowed else before
    assert during == expected


@needs_scheduler
def test_a_system_that_refuses_is_reported(monkeypatch):
    def refuse(*words):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not set_priority(LOOP, REAL)


@needs_scheduler
def test_the_loop_is_never_above_the_watchdog(monkeypatch):
    taken = []

    def allow_ten(pid, policy, parameters):
        if parameters.sched_priority >= WATCHDOG:
            raise PermissionError(1, "Operation not permitted")
        taken.append(parameters.sched_priority)

    monkeypatch.setattr(os, "sched_setscheduler", allow_ten)
    assert not set_loop_priority(REAL)
    assert taken == []


def test_simulated_time_needs_none(monkeypatch):
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    assert not set_priority(LOOP, SimulatedClock())


def test_a_session_has_it_while_its_fin_is_active(monkeypatch):
    calls = []
    monkeypatch.setattr(
        "softfin.rig.session.set_priority", lambda priority, clock: calls.append(priority)
    )
    monkeypatch.setattr("softfin.rig.session.set_loop_priority", lambda clock: calls.append(LOOP))
    with Made().session as session:
        session.activate()
        assert calls == [LOOP]
        session.deactivate()
        assert calls == [LOOP, NORMAL]
        session.activate()
        calls.clear()
    assert calls == [NORMAL]
