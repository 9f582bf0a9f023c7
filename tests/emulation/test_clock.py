"""Simulated time: one thread at a time, the same in every run, as fast as it goes; nothing here
waits for real time."""

import random
import signal
import subprocess
import sys
import threading
import time

import pytest

from softfin.core.clock import REAL, Clock
from softfin.emulation.clock import SimulatedClock
from tests.patience import HANG_S


def after(clock, began=1000.0):
    return round(clock() - began, 6)


@pytest.mark.parametrize("clock", [REAL, SimulatedClock()], ids=["real", "simulated"])
def test_both_clocks_count_no_suspend_while_the_computer_is_awake(clock):
    before = clock.suspended()
    clock.sleep(0.01)
    assert clock.suspended() - before == pytest.approx(0.0, abs=0.006)


def test_a_platform_that_does_not_count_suspends_has_none(monkeypatch):
    monkeypatch.delattr(time, "CLOCK_BOOTTIME")
    assert REAL.suspended() == 0.0


def test_the_time_asleep_is_what_one_clock_counts_more_than_the_other(monkeypatch):
    # The second reading of the first pair comes late: the thread lost the processor.
    readings = iter([10.0, 52.0, 10.1, 20.0, 62.0, 20.001])
    monkeypatch.setattr(time, "clock_gettime", lambda clock: next(readings))
    assert REAL.suspended() == pytest.approx(42.0)


@pytest.mark.parametrize("clock", [REAL, SimulatedClock()], ids=["real", "simulated"])
def test_both_clocks_make_what_is_waited_for(clock):
    assert isinstance(clock, Clock)
    event = clock.event()
    news = clock.condition()
    lock = clock.lock()
    told = []

    def work():
        event.wait()
        with lock, news:
            told.append("worked")
            news.notify_all()

    thread = clock.spawn(work, "worker")
    with news:
        event.set()
        assert news.wait_for(lambda: bool(told))
    thread.join()
    assert not thread.is_alive()
    assert not news_within(clock, 0.001)
    assert not clock.event().wait(0.001)
    assert lock.acquire(timeout=1.0)
    assert lock.acquire(timeout=0.001)
    lock.release()
    lock.release()
    assert 0 <= clock.wall() - time.time() + 3600 < 2 * 3600


def news_within(clock, seconds):
    news = clock.condition()
    with news:
        return news.wait(seconds)


def test_hours_pass_at_once_and_to_the_moment():
    clock = SimulatedClock()
    began = time.monotonic()
    wall = clock.wall()
    clock.sleep(3600.0)
    assert after(clock) == 3600
    assert clock.wall() - wall == pytest.approx(3600)
    # Nobody slept through them.
    assert time.monotonic() - began < 3600


def play(seed):
    """Six threads that sleep, wake each other, and wait for a lock, as chance has it."""
    clock = SimulatedClock()
    draw = random.Random(seed)
    seen = []
    event = clock.event()
    news = clock.condition()
    lock = clock.lock()

    def work(name):
        for _ in range(30):
            what = draw.randrange(5)
            if what == 0:
                clock.sleep(draw.choice((0.0, 0.001, 0.002)))
            elif what == 1:
                seen.append((name, "event", event.wait(draw.choice((0.001, 0.003)))))
            elif what == 2:
                event.set()
                with news:
                    news.notify_all()
                event.clear()
            elif what == 3:
                with news:
                    seen.append((name, "news", news.wait(0.002)))
            else:
                with lock:
                    clock.sleep(0.001)
            seen.append((name, what, clock()))

    for thread in [clock.spawn(lambda name=name: work(name), name) for name in "abcdef"]:
        thread.join()
    return seen


@pytest.mark.parametrize("seed", range(5))
def test_the_same_seed_gives_the_same_turns_at_the_same_times(seed):
    first = play(seed)
    assert first == play(seed)
    assert len({name for name, _, _ in first}) == 6
    assert first != play(seed + 100)


def test_only_one_member_runs_at_a_time_and_computing_takes_no_time():
    clock = SimulatedClock()
    inside = [0]
    most = [0]

    def work():
        for _ in range(20):
            inside[0] += 1
            most[0] = max(most[0], inside[0])
            # Gives up Python's lock, so that anybody who might run would.
            time.sleep(0)
            inside[0] -= 1
            clock.sleep(0.01)

    for thread in [clock.spawn(work, f"worker {k}") for k in range(4)]:
        thread.join()
    assert most == [1]
    assert after(clock) == 0.2


def test_those_who_wait_for_the_same_moment_go_on_in_the_order_in_which_they_came():
    clock = SimulatedClock()
    order = []

    def work(name):
        clock.sleep(0.5)
        order.append(name)

    threads = [clock.spawn(lambda name=name: work(name), name) for name in "dacb"]
    clock.sleep(0.5)
    order.append("first")
    for thread in threads:
        thread.join()
    assert order == ["first", "d", "a", "c", "b"]


def test_an_event_wakes_at_once_and_a_timeout_at_its_moment():
    clock = SimulatedClock()
    event = clock.event()

    def work():
        clock.sleep(0.25)
        event.set()

    clock.spawn(work, "setter")
    assert not event.wait(0.1)
    assert after(clock) == 0.1
    assert event.wait(10.0)
    assert after(clock) == 0.25
    assert event.wait(10.0)
    event.clear()
    assert not event.is_set()
    assert not event.wait(0.5)
    assert after(clock) == 0.75


def test_a_condition_lets_go_of_its_lock_while_it_waits_and_has_it_again_after():
    clock = SimulatedClock()
    news = clock.condition()
    heard = []

    def work():
        with news, news:
            heard.append(news.wait(5.0))
            clock.sleep(0.1)
            heard.append(after(clock))

    thread = clock.spawn(work, "listener")
    clock.sleep(0.2)
    with news:
        news.notify_all()
    clock.sleep(0.0)
    assert not news.acquire(timeout=0.05)
    assert news.acquire(timeout=0.06)
    news.release()
    thread.join()
    assert heard == [True, 0.3]


def test_a_lock_is_waited_for_until_its_timeout():
    clock = SimulatedClock()
    lock = clock.lock()

    def work():
        with lock:
            clock.sleep(1.0)

    thread = clock.spawn(work, "holder")
    clock.sleep(0.0)
    assert not lock.acquire(blocking=False)
    assert not lock.acquire(timeout=0.3)
    assert after(clock) == 0.3
    assert lock.acquire()
    assert after(clock) == 1.0
    lock.release()
    thread.join()


def test_a_thread_of_somebody_else_is_woken_but_not_waited_for():
    clock = SimulatedClock()
    held = threading.Event()
    told = []
    event = clock.event()

    def elsewhere():
        held.wait(HANG_S)
        clock.sleep(1.0)
        told.append(clock() >= 1001.0)
        event.set()

    thread = threading.Thread(target=elsewhere, daemon=True)
    thread.start()
    # It is held up, and nobody waits for it.
    clock.sleep(0.5)
    assert (told, after(clock)) == ([], 0.5)
    held.set()
    # No deadline: whoever wakes this one comes from outside.
    assert event.wait()
    thread.join(HANG_S)
    assert told == [True]


def test_a_thread_that_fails_ends_and_the_others_go_on(monkeypatch):
    told = []
    monkeypatch.setattr(threading, "excepthook", lambda failed: told.append(str(failed.exc_value)))
    clock = SimulatedClock()

    def work():
        clock.sleep(0.1)
        raise ValueError("of a test")

    thread = clock.spawn(work, "failing")
    thread.join(5.0)
    assert not thread.is_alive()
    assert after(clock) == 0.1
    assert told == ["of a test"]


def test_ctrl_c_gets_through_and_leaves_the_clock_whole():
    clock = SimulatedClock()
    turns = []

    def work():
        clock.sleep(1.0)
        signal.raise_signal(signal.SIGINT)
        for _ in range(3):
            turns.append(after(clock))
            clock.sleep(1.0)

    thread = clock.spawn(work, "worker")
    # The signal comes while this thread waits and the other one runs.
    with pytest.raises(KeyboardInterrupt):
        clock.sleep(1.5)
    thread.join(10.0)
    assert not thread.is_alive()
    assert turns == [1, 2, 3]
    clock.sleep(1.0)


def test_a_program_that_ends_does_not_wait_for_its_threads():
    program = (
        "from softfin.emulation.clock import SimulatedClock\n"
        "clock = SimulatedClock()\n"
        "clock.spawn(lambda: [clock.sleep(0.01) for _ in iter(int, 1)], 'endless')\n"
        "clock.sleep(1.0)\n"
        "print(round(clock(), 3))\n"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=HANG_S, check=False
    )
    assert (ran.stdout, ran.stderr, ran.returncode) == ("1001.0\n", "", 0)
