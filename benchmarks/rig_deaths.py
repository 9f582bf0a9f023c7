"""Hosts that are killed or stopped and cables that are cut, at random moments: how soon each fin
stands by itself.

In simulated time with one fin, and with four on one bus; in real time with hosts that are processes
of their own, one fin, and two on one bus. The emulators are in this process, which also watches the
fins. Options by environment: SOFTFIN_DEATHS trials of each kind in simulated time (100),
SOFTFIN_DEATHS_REAL in real time (100), SOFTFIN_DEATHS_SEED of the first trial (0). What fails is
printed with its seed; in simulated time the seed repeats it.
"""

import contextlib
import multiprocessing
import os
import random
import signal
import statistics
import sys
from collections.abc import Callable, Iterator
from multiprocessing.process import BaseProcess
from typing import Any

from tests.rig.deaths import (
    AFTERWARDS_S,
    BUS_CUT,
    CABLE_CUT,
    HOST_DIES,
    MOMENTS_S,
    SIMULATED_MARGIN_S,
    Fleet,
    Outcome,
    Trial,
    cut,
    run_simulated_trial,
    swim_by_values,
)

from benchmarks.measure import entry
from softfin.rig.computer import COMPUTER

SIMULATED_TRIALS = int(os.environ.get("SOFTFIN_DEATHS", "100"))
REAL_TRIALS = int(os.environ.get("SOFTFIN_DEATHS_REAL", "100"))
FIRST_SEED = int(os.environ.get("SOFTFIN_DEATHS_SEED", "0"))

KILLED = "host killed (SIGKILL)"
STOPPED = "host stopped (SIGSTOP)"

SIMULATED_KINDS = ((1, HOST_DIES), (1, CABLE_CUT), (4, HOST_DIES), (4, CABLE_CUT), (4, BUS_CUT))
# The frames of four fins would take more than one core of a bus that is served by Python, and
# arrive seconds late.
REAL_KINDS = tuple((count, kind) for count in (1, 2) for kind in (KILLED, STOPPED, CABLE_CUT))

SIMULATED_HEARTBEAT_S = 0.2
REAL_HEARTBEAT_S = 0.5
"""More than the default, because hosts that live may be late by as much on a busy computer."""

REAL_MARGIN_S = SIMULATED_MARGIN_S + 0.1
"""The threads of the emulators share a process with the watcher and a computer with the hosts: a
step of 5 ms may be late by tens of milliseconds. The row's look_worst_ms shows how late these
threads are, its lag_worst_ms how late frames of a dead host came in, which the limit does not
include."""

RunTrial = Callable[[Trial], tuple[Outcome, float]]


def main() -> list[dict[str, Any]]:
    rows = []
    for count, kind in SIMULATED_KINDS:
        rows.append(_measure("simulated", count, kind, SIMULATED_TRIALS, _run_simulated_trial))

    context = multiprocessing.get_context("forkserver")
    # A host that is forked from a process with everything imported moves its fin after one second
    # instead of ten.
    context.set_forkserver_preload(["tests.rig.deaths"])
    for count, kind in REAL_KINDS:
        rows.append(
            _measure(
                "real time", count, kind, REAL_TRIALS, lambda trial: _run_real_trial(trial, context)
            )
        )
    return rows


def _measure(time: str, count: int, kind: str, trials: int, run_trial: RunTrial) -> dict[str, Any]:
    """Run the trials of one kind: the share of them in which every fin did what it had to."""
    outcomes = []
    failed_seeds = []
    limit_s = 0.0
    for seed in range(FIRST_SEED, FIRST_SEED + trials):
        trial = Trial(kind, count, seed)
        outcome, limit_s = run_trial(trial)
        outcomes.append(outcome)
        if problem := trial.problem(outcome, limit_s):
            failed_seeds.append(seed)
            sys.stderr.write(f"{time}: {problem}\n")
    rest_ms = [1e3 * outcome.rest_s for outcome in outcomes]
    fins = "1 fin" if count == 1 else f"{count} fins on one bus"
    return entry(
        f"{kind}, {fins}, {time}: trials passed",
        100.0 * (trials - len(failed_seeds)) / trials,
        "%",
        100,
        trials=trials,
        rest_p50_ms=statistics.median(rest_ms),
        rest_worst_ms=max(rest_ms),
        limit_ms=1e3 * limit_s,
        way_worst_rad=max(outcome.way_rad for outcome in outcomes),
        others_disturbed=sum(len(outcome.disturbed) for outcome in outcomes),
        lag_worst_ms=1e3 * max(outcome.lag_s for outcome in outcomes),
        look_worst_ms=1e3 * max(outcome.look_s for outcome in outcomes),
        failed_seeds=failed_seeds,
    )


def _run_simulated_trial(trial: Trial) -> tuple[Outcome, float]:
    return run_simulated_trial(trial, SIMULATED_HEARTBEAT_S)


def _run_real_trial(trial: Trial, context: Any) -> tuple[Outcome, float]:
    """Return what was seen and the limit [s], in real time with hosts that are processes."""
    numbers = trial.numbers
    with (
        Fleet(trial.count, REAL_HEARTBEAT_S, COMPUTER) as fleet,
        _hosts(fleet, numbers, context) as hosts,
    ):
        place = numbers.randrange(trial.count)
        victim = fleet.stations[place]
        fleet.await_swimming(victim)
        COMPUTER.sleep(numbers.uniform(0.0, MOMENTS_S))
        if trial.kind == CABLE_CUT:
            cut([victim])
        else:
            _signal(hosts[place], signal.SIGKILL if trial.kind == KILLED else signal.SIGSTOP)
        limit_s = fleet.limit_s + REAL_MARGIN_S
        outcome = fleet.watch([victim], limit_s + AFTERWARDS_S)
        if trial.kind == STOPPED:
            _signal(hosts[place], signal.SIGCONT)
            outcome = outcome.then(fleet.watch([victim], AFTERWARDS_S))
        return outcome, limit_s


@contextlib.contextmanager
def _hosts(fleet: Fleet, numbers: random.Random, context: Any) -> Iterator[list[BaseProcess]]:
    """Start a process for each fin; all are killed at the end."""
    hosts: list[BaseProcess] = []
    try:
        for station in fleet.stations:
            host = context.Process(
                target=swim_by_values, args=(station.values, numbers.randrange(2**32)), daemon=True
            )
            host.start()
            hosts.append(host)
        yield hosts
    finally:
        for host in hosts:
            host.kill()
            host.join()


def _signal(host: BaseProcess, number: signal.Signals) -> None:
    assert host.pid is not None
    os.kill(host.pid, number)
