"""A robot in simulation: it holds its place, follows a path, goes on without a fin."""

import numpy as np
import pytest

from softfin.core.errors import RunError
from softfin.robot.baselines import build_drivers
from softfin.robot.evaluate import RobotEvaluateConfig, trial
from softfin.robot.motion_control import MotionController
from softfin.robot.noise import NoiseConfig
from softfin.robot.paths import hold_place, lemniscate, lissajous
from softfin.robot.simulation import RobotSimulation
from softfin.robot.trial import Disturbances, run_trial
from softfin.robot.wrench_driver import WrenchDriver
from softfin.tank import Tank

SHORT = RobotEvaluateConfig(hold_s=40, settled_s=12, path_s=45)
LONG = RobotEvaluateConfig(hold_s=120, settled_s=30)


@pytest.mark.slow
def test_it_holds_its_place_against_a_push_and_a_current(ucat, simulation, gaits):
    record, row = trial(simulation, build_drivers(ucat, gaits)["whole"], "hold", LONG, 0)
    assert row["position_rms_m"] < 0.02
    assert row["attitude_rms_deg"] < 2
    assert len(record.time) == 12000


@pytest.mark.slow
@pytest.mark.parametrize("task", ["lemniscate", "lissajous"])
def test_it_follows_paths(ucat, simulation, gaits, task):
    record, row = trial(simulation, build_drivers(ucat, gaits)["whole"], task, SHORT, 1)
    assert row["position_rms_m"] < 0.06
    assert np.ptp(record.body.position[:, 0]) > 1


@pytest.mark.slow
def test_it_goes_on_holding_when_a_fin_dies(ucat, simulation, gaits):
    trouble = Disturbances(current_m_s=(-0.03, 0.0, 0.0), dead_fin=2, dead_at_s=5)
    record = run_trial(simulation, WrenchDriver(ucat, gaits), hold_place(), 40, trouble, seed=3)
    assert np.sqrt((record.position_error()[-1500:] ** 2).mean()) < 0.06
    np.testing.assert_allclose(record.forces[-1, 2], 0, atol=1e-9)


@pytest.mark.parametrize("seconds", [3.34, 3.6, 3.9])
@pytest.mark.parametrize(("task", "dead"), [("hold", False), ("hold", True), ("lemniscate", True)])
def test_a_trial_may_last_for_any_time(ucat, simulation, gaits, task, dead, seconds):
    config = RobotEvaluateConfig(hold_s=seconds, path_s=seconds, settled_s=0.995, dead=dead)
    record, row = trial(simulation, build_drivers(ucat, gaits)["whole"], task, config, 1)
    assert record.time[-1] == pytest.approx(seconds, abs=0.18)
    assert np.isfinite(row["position_rms_m"])


@pytest.mark.parametrize("dead", [False, True])
def test_a_trial_in_which_no_time_may_count_is_refused(dead):
    with pytest.raises(
        ValueError,
        match=r"hold_s = 3.3: must be at least 3.3[45] s with settled_s = 1, otherwise nothing is evaluated",
    ):
        RobotEvaluateConfig(hold_s=3.3, settled_s=1, dead=dead)


def test_the_shaft_of_a_dead_fin_stays_where_it_is(ucat, simulation, gaits, monkeypatch):
    death_s = 2.4
    angles = []
    advance = simulation.advance

    def watch(state, orders, around, ticks):
        after = advance(state, orders, around, ticks)
        angles.append(np.asarray(after[0].fins.drive.angle))
        return after

    monkeypatch.setattr(simulation, "advance", watch)
    # Strokes that begin a third and two thirds into an action: two fins are amid them when it ends.
    for fin in range(4):
        angles.clear()
        trouble = Disturbances(current_m_s=(0.05, 0.0, 0.0), dead_fin=fin, dead_at_s=death_s)
        driver = WrenchDriver(ucat, gaits, np.array([0, 1, 2, 5]))
        run_trial(simulation, driver, hold_place(), 6, trouble)
        death = int(np.ceil(death_s * 3 - 1e-6))
        moved = np.array(angles)[death:, fin] - angles[death - 1][fin]
        # Within the drive's dead time and braking; nothing from then on.
        assert abs(moved[0]) < 0.2
        np.testing.assert_allclose(moved[1:], moved[0], atol=1e-3)


@pytest.mark.slow
def test_without_a_fin_it_turns_into_a_current_to_either_side_and_holds(sister, gaits):
    simulation = RobotSimulation(sister, [Tank()] * 4)
    current = (0.05 * np.cos(np.radians(-61)), 0.05 * np.sin(np.radians(-61)), 0.0)
    trouble = Disturbances(current_m_s=current, dead_fin=0, dead_at_s=20)
    for seed in range(4):
        record = run_trial(
            simulation, WrenchDriver(sister, gaits), hold_place(), 90, trouble, seed=seed
        )
        assert np.sqrt((record.position_error()[-3000:] ** 2).mean()) < 0.1


@pytest.mark.slow
def test_without_noise_and_disturbance_it_stays_where_it_is(ucat, simulation, gaits):
    none = NoiseConfig(position_m=0, attitude_rad=0, velocity_m_s=0, rate_rad_s=0)
    record = run_trial(simulation, WrenchDriver(ucat, gaits), hold_place(), 10, noise=none)
    assert record.position_error().max() < 0.005


@pytest.mark.parametrize("path", [hold_place((1, 2, 3), 0.5), lemniscate(0.1), lissajous(0.1)])
def test_velocity_and_acceleration_are_the_path_s_derivatives(path):
    for time in (0.0, 4.0, 30.0):
        before, now, after = (path(time + k * 0.02) for k in (-1, 0, 1))
        np.testing.assert_allclose(
            (after.position - before.position) / 0.04, now.velocity, atol=2e-4
        )
        np.testing.assert_allclose(
            (after.velocity - before.velocity) / 0.04, now.acceleration, atol=2e-3
        )


def test_paths_begin_slowly_and_reach_their_speed():
    path = lissajous(0.1)
    assert np.linalg.norm(path(0.0).velocity) < 1e-3
    speeds = [np.linalg.norm(path(time).velocity) for time in np.linspace(20, 20 + 5, 200)]
    assert 0.05 < np.mean(speeds) < 0.2


def test_a_state_that_is_not_finite_is_refused(ucat):
    controller = MotionController(ucat)
    still = hold_place()(0.0)
    seen = [np.full((1, 3), np.nan), still.attitude[None], np.zeros((1, 6))]
    with pytest.raises(RunError, match="not finite"):
        controller.act(controller.init(), seen, still, still, still)
