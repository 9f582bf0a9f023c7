"""Hosts that die and cables that are cut: each fin stands by itself within heartbeat_s and its
braking time.

A few moments of each kind; `python -m benchmarks rig_deaths` has a hundred of each, and real
processes.
"""

import math
import random

import pytest

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2.drive import DriveTraits
from tests.rig.braking_fin import BrakingFin
from tests.rig.deaths import (
    AFTERWARDS_S,
    BUS_CUT,
    CABLE_CUT,
    HOST_DIES,
    Fleet,
    Trial,
    cut,
    run_simulated_trial,
    simulated_hosts,
)

HEARTBEAT_S = 0.2


@pytest.mark.parametrize(
    ("kind", "count"),
    [(HOST_DIES, 1), (CABLE_CUT, 1), (HOST_DIES, 4), (CABLE_CUT, 2), (BUS_CUT, 2)],
)
def test_a_fin_stands_in_time_after_a_death_at_a_random_moment_and_the_others_swim_on(
    kind: str, count: int
) -> None:
    for seed in range(3 if count == 1 else 1):
        trial = Trial(kind, count, seed)
        outcome, limit_s = run_simulated_trial(trial)
        assert trial.problem(outcome, limit_s) is None
        assert outcome.way_rad > 0.0
        assert outcome.lag_s == 0.0


def test_a_drive_that_goes_on_without_its_host_fails_the_trial() -> None:
    trial = Trial(HOST_DIES, 1, 0)
    outcome, limit_s = run_simulated_trial(trial, traits=DriveTraits(ignores_heartbeat=True))
    assert outcome.rest_s == math.inf
    assert "at rest after inf s" in str(trial.problem(outcome, limit_s))


def test_a_fin_that_stops_although_its_host_lives_fails_the_trial() -> None:
    clock = SimulatedClock()
    with Fleet(2, HEARTBEAT_S, clock) as fleet, simulated_hosts(fleet, clock, random.Random(0)):
        fleet.await_swimming(fleet.stations[0])
        cut(fleet.stations)
        outcome = fleet.watch(fleet.stations[:1], fleet.limit_s + AFTERWARDS_S)
        assert [line.split(":")[0] for line in outcome.disturbed] == ["fin 2"]
        assert Trial(CABLE_CUT, 2, 0).problem(outcome, math.inf) is not None


def test_a_host_whose_cable_is_cut_says_that_its_stop_is_not_confirmed() -> None:
    clock = SimulatedClock()
    with (
        Fleet(1, HEARTBEAT_S, clock) as fleet,
        simulated_hosts(fleet, clock, random.Random(0)) as hosts,
    ):
        fleet.await_swimming(fleet.stations[0])
        clock.sleep(0.2)
        cut(fleet.stations)
        clock.sleep(5.0)
        assert isinstance(hosts[0].error, SafetyStop)
        assert "BUT drive did not confirm that its motor is off" in str(hosts[0].error)


def test_a_death_is_the_same_each_time_that_its_seed_repeats_it() -> None:
    trial = Trial(HOST_DIES, 1, 7)
    assert run_simulated_trial(trial) == run_simulated_trial(trial)


def test_a_braking_fin_needs_the_time_and_the_way_of_its_deceleration() -> None:
    clock = SimulatedClock()
    fin = BrakingFin(10.0, clock)
    fin.move(1.5, 2.0)
    clock.sleep(0.25)
    assert fin.now().angle == pytest.approx(0.5)
    assert fin.now().velocity == 2.0
    fin.halt()
    clock.sleep(0.1)
    assert fin.now().velocity == pytest.approx(1.0)
    clock.sleep(0.1 + 1e-9)
    assert fin.now().velocity == 0.0
    assert fin.now().angle == pytest.approx(0.5 + 2.0**2 / (2 * 10.0))
