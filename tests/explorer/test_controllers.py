"""The controllers in the page act as softfin's own do with NumPy, command for command."""

import dataclasses

import numpy as np
import pytest

from softfin.control.controller import Measured
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.references import nearest_trackable
from softfin.control.store import load_controller
from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import CoverageError
from softfin.core.operations import NUMPY, select_operations
from softfin.core.quantities import Command, Limits
from softfin.core.window import moving_error, sobolev, window_mean
from softfin.explorer.contents import (
    controller_data,
    hand_data,
    plant_data,
    surrogate_data,
    tank_data,
)
from softfin.gaits.reachable import Reachable
from softfin.tank import Tank, TankConfig
from tests.control.folders import KINDS, folder_option
from tests.control.test_numpy import episode
from tests.explorer import families, fins, node
from tests.surrogate.streaming import small

ACT = """
output = ["none", "force"].map((uses) => {
  const controller = new Controller(input.controller);
  controller.useFeedback(uses, 0);
  return input.episode.map(([angle, force, reference]) => {
    const command = controller.act({ angle, force }, reference);
    return [command.angle, command.velocity];
  });
});
"""

LOOP = """
const plants = { own: new StreamingSurrogate(input.plant) };
const loop = new Loop(plants, "own", new Controller(input.controller), input.references[0]);
loop.controller.useFeedback("force", 0);
output = input.references.map((reference) => {
  loop.reference = reference;
  const { force } = loop.tick(), window = loop.averages.own;
  return [loop.command.angle, loop.command.velocity, ...force, ...window.mean(), ...loop.error(), ...window.sobolev()];
});
"""


@pytest.fixture(scope="module")
def controllers(tmp_path_factory):
    out = tmp_path_factory.mktemp("controllers")
    return {kind: load_controller(folder_option(kind, out)) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_a_controller_commands_what_it_commands_with_numpy(controllers, kind):
    controller = controllers[kind]
    played = episode(5)
    rows = [list(row) for row in zip(*(part.tolist() for part in played), strict=True)]
    page = np.array(node.run(ACT, controller=controller_data(controller), episode=rows))
    for acting, commands in zip((controller, Feedback(controller)), page, strict=True):
        state = acting.init()
        expected = []
        for angle, force, reference in rows:
            state, command = acting.act(state, Measured(angle, np.array(force)), tuple(reference))
            expected.append(tuple(command))
        np.testing.assert_allclose(commands, expected, atol=1e-5, rtol=0)
    assert np.abs(page[0] - page[1]).max() > 1e-3


def closed(controller, surrogate, references):
    """Command and force of every tick, with feedback, under a reference that each action
    observes anew."""
    acting = Feedback(controller)
    (plant, roll) = fins.roll_surrogate(surrogate)
    state = acting.init()
    rows = []
    measured = Measured(0.0, np.zeros(2))
    for ticks in (33, 33, 34) * (len(references) // 100):
        state, command = acting.act(state, measured, tuple(references[len(rows)].tolist()))
        plant, reading, _ = roll(plant, Command(*(np.full(ticks, part) for part in command)))
        rows += [[*command, *force] for force in reading[:, 2:]]
        measured = Measured(float(reading[-1, 0]), reading[:, 2:].mean(axis=0))
    return np.array(rows)


@pytest.mark.parametrize("kind", ["single", "grid", "gaits"])
def test_thirty_seconds_of_moving_references_are_the_same_in_the_closed_loop(controllers, kind):
    controller = controllers[kind]
    surrogate = small.surrogate()
    time = np.arange(3000) / 100
    jumps = np.where((time > 12) & (time < 20), 0.9, 0.0)
    references = np.stack([2 + np.sin(time), jumps - 0.6 * np.cos(0.7 * time)], axis=1)
    page = np.array(
        node.run(
            LOOP,
            controller=controller_data(controller),
            plant=surrogate_data(surrogate),
            references=references.tolist(),
        ),
        float,
    )
    assert np.all(np.isfinite(page[:, 6:8]).all(axis=1) == (np.arange(len(page)) >= 199))
    expected = closed(controller, surrogate, references)
    np.testing.assert_allclose(page[:, :2], expected[:, :2], atol=1e-5, rtol=0)
    # Controllers run in single precision with NumPy, and what that rounds off the commands shows at
    # corners of the force.
    np.testing.assert_allclose(page[:, 2:4], expected[:, 2:], atol=8e-5, rtol=0)
    for tick in (50, 199, 1000, 2999):
        force = expected[: tick + 1, 2:]
        count = np.int64(min(tick + 1, 200))
        np.testing.assert_allclose(page[tick, 4:6], window_mean(force, count), atol=1e-5)
        np.testing.assert_allclose(page[tick, 8:10], sobolev(force, count), atol=1e-5)
    last = moving_error(expected[-200:, 2:], references[-1])
    np.testing.assert_allclose(page[-1, 6:8], last, atol=1e-5)


def test_a_force_that_cannot_be_held_is_moved_to_the_nearest_that_can(controllers):
    numbers = np.random.default_rng(1)
    compared = 0
    for kind in ("single", "grid", "gaits"):
        controller = controllers[kind]
        forces = numbers.uniform((-2, -4), (6, 4), (40, 2))
        page = np.array(
            node.run(
                """
            const { cells, reachable } = input.controller;
            const region = reachable === null ? null : new Reachable(reachable);
            output = input.forces.map((force) => nearestReference(cells, region, force));
            """,
                controller=controller_data(controller),
                forces=forces.tolist(),
            )
        )
        for force, near in zip(forces, page, strict=True):
            try:
                expected = nearest_trackable(controller, force[None])[0]
            except CoverageError:
                # The page holds the nearest in a cell there, where softfin run would refuse it.
                controller.check(tuple(near.tolist()))
                continue
            compared += 1
            # Two forces may be almost equally near.
            np.testing.assert_allclose(near, expected, atol=2e-2)
            distances = np.linalg.norm(np.stack([near, expected]) - force, axis=1)
            assert distances[0] == pytest.approx(distances[1], abs=2e-3)
    assert compared > 20


@pytest.mark.parametrize("radius_n", [0.02, 2.0, 200.0])
def test_the_tolerance_at_the_edge_of_a_region_is_that_of_softfin_at_any_size(radius_n):
    region = Reachable(np.zeros(2, np.float32), np.full(72, radius_n, np.float32))
    distances = radius_n * np.array([0.99, 1.0003, 1.0005, 1.03])
    script = "output = input.forces.map((force) => new Reachable(input.region).contains(force));"
    forces = [[float(distance), 0.0] for distance in distances]
    page = node.run(script, region=region.to_dict(), forces=forces)
    assert page == [bool(region.contains(force)) for force in forces] == [True, True, False, False]


def test_a_hand_strokes_to_both_sides_within_the_limits_of_all_plants():
    limits = [Limits(-1.5, 1.0, 1.0, 7.0), Limits(-1.2, 1.6, 2.0, 5.0)]
    hand = hand_data(limits, PAPER_CLOCK, 1.0)
    assert hand["limits"] == Limits(-1.2, 1.0, 2.0, 5.0).to_dict()
    assert hand["first"] == {"angle": 0.0, "stroke": 0.5, "velocity": pytest.approx(4.5)}
    commands = node.run(
        """
        const hand = new Hand(input.hand);
        hand.angle = 0.8;
        output = [0, 1, 2].map(() => { const { angle, velocity } = hand.act(); return [angle, velocity]; });
        """,
        hand=hand,
    )
    np.testing.assert_allclose(commands, [[1.0, 4.5], [0.3, 4.5], [1.0, 4.5]])


def test_without_a_controller_the_size_of_a_fin_shows_in_its_peak_force():
    """The page draws forces on this scale."""
    peaks = []
    for length_m in (0.187, 0.0935):
        tank = Tank(TankConfig.build({"fin": {"length_m": length_m}}, "fin"))
        hand = hand_data([tank.limits], PAPER_CLOCK, None)
        peaks.append(
            node.run(
                "output = peakForce(new Tank(input.plant), input.hand);",
                plant=plant_data("tank", tank),
                hand=hand,
            )
        )
    assert peaks[0] == pytest.approx(10, abs=1), "PAPER_PEAK_N in page.js"
    assert peaks[1] < peaks[0] / 2


FEEDBACK = """
const controller = new Controller(input.controller);
controller.useFeedback(input.uses, 0);
output = input.episode.map(({ reference, ...measured }) => {
  const command = controller.act(measured, reference);
  const { mean, half, level } = controller.feedback.estimate();
  return [command.angle, command.velocity, ...mean, ...half, level];
});
"""


def play(feedback, family):
    """Measurements of fins that differ from each other from one stretch to the next, with
    references that move, and what feedback commands and estimates."""
    numbers = np.random.default_rng(5)
    actions = feedback.clock.window_actions
    state = feedback.init()
    rows = []
    expected = []
    measured = Measured(0.0, *np.zeros((3, 2)))
    stretches = [[0, 0, 0], [1, -0.5, 0.3], [1, -0.5, 0.3], [-1, 1, 1], [0, 0, 0]]
    for stretch, coefficients in enumerate(stretches):
        is_torn = stretch == 3
        reference = numbers.uniform((1, 0), (2, 1))
        for age in range(4 * actions):
            if age > 2 * actions:
                reference = reference + numbers.normal(size=2) * 0.01
            given = {name: np.asarray(part).tolist() for name, part in measured._asdict().items()}
            rows.append({**given, "reference": reference.tolist()})
            state, command = feedback.act(state, measured, reference)
            found = feedback.estimate(state)
            expected.append([*command, *found.force, *found.half_width, found.level])
            own = (np.array([age % actions]),)
            (nominal,) = family.interpolate(NUMPY, state.tracked[-1:], family.nominal, own=own)
            (changes,) = family.interpolate(NUMPY, state.tracked[-1:], family.features, own=own)
            seen = nominal[0] + coefficients @ changes[0]
            seen = seen + family.feature_spread * numbers.normal(size=7) * (1 if is_torn else 0.01)
            measured = Measured(seen[2], seen[:2], seen[3:5], seen[5:])
    return rows, np.array(expected, float)


@pytest.mark.parametrize("uses", ["force", "torque", "both"])
@pytest.mark.parametrize(
    "clock", [PAPER_CLOCK, ActionClock.at(5), ActionClock.at(8, 0.75)], ids=str
)
def test_feedback_finds_and_commands_what_it_does_with_numpy_while_the_fin_changes(clock, uses):
    controller = families.gaits_at(clock)
    family = families.random_family(controller)
    feedback = Feedback(controller, FeedbackConfig(uses=uses), family)
    rows, expected = play(feedback, family)
    data = controller_data(controller, family)
    script = f"useClock(input.controller.clock);{FEEDBACK}"
    page = np.array(node.run(script, controller=data, uses=uses, episode=rows))
    np.testing.assert_allclose(page[:, :2], expected[:, :2], atol=1e-5)
    np.testing.assert_allclose(page[:, 2:6], expected[:, 2:6], atol=1e-6)
    np.testing.assert_allclose(page[:, 6], expected[:, 6], rtol=1e-5)
    assert np.ptp(expected[:, 6]) > 3, "the fin is not always of the family"


def test_feedback_sees_the_means_of_force_torque_and_power_over_each_action():
    controller = families.gaits_at(PAPER_CLOCK)
    ticks, measured = node.run(
        """
        const loop = new Loop({ tank: new Tank(input.plant) }, "tank", new Controller(input.controller), [1.5, 0.5]);
        const ticks = [], measured = [], act = loop.controller.act.bind(loop.controller);
        loop.controller.act = (now, reference) => {
          measured.push([now.angle, ...now.force, ...now.shaft, ...now.motor]);
          return act(now, reference);
        };
        for (let k = 0; k < 301; k++) {
          const { angle, velocity, force, torque, motorTorque } = loop.tick();
          ticks.push([angle, ...force, torque, velocity, motorTorque, velocity]);
        }
        output = [ticks, measured];
        """,
        controller=controller_data(controller),
        plant=tank_data(Tank(TankConfig(sensor=fins.QUIET))),
    )
    assert measured[0] == [0] * 7
    ends = np.cumsum(PAPER_CLOCK.action_ticks(9))
    for end, start, seen in zip(ends, [0, *ends[:-1]], measured[1:], strict=True):
        action = np.array(ticks[start:end])
        velocity = action[:, 4]
        # Torques are means over a tick, velocities from its end.
        between = (np.concatenate([velocity[:1], velocity[:-1]]) + velocity) / 2
        action[:, [4, 6]] = action[:, [3, 5]] * between[:, None]
        np.testing.assert_allclose(seen, [action[-1, 0], *action[:, 1:].mean(axis=0)], atol=1e-12)
    assert np.ptp(measured, axis=0).min() > 0.01


def test_feedback_that_begins_within_a_window_waits_for_a_full_one():
    controller = families.gaits_at(PAPER_CLOCK)
    data = controller_data(controller, families.random_family(controller))
    changed = node.run(
        """
        const controller = new Controller(input.controller), measured = { angle: 0.1, force: [1, 0], shaft: [0.1, 0.2], motor: [0.1, 0.3] };
        output = [];
        for (let action = 0; action < 30; action++) {
          if (action === 15) controller.useFeedback("both", action);
          controller.act(measured, [1.5, 0.5]);
          if (action >= 15 && controller.feedback.mean.some((value) => value !== 0)) output.push(action);
        }
        """,
        controller=data,
    )
    assert changed == list(range(24, 30))


def test_where_cells_touch_the_same_policy_acts(controllers):
    """1.1 has no exact single precision, in which NumPy has references and cells."""
    grid = controllers["grid"]
    edges = ((0.5, 1.1), (1.1, 3.5))
    forces = [[1.1, 0.0], [0.9, 0.0], [1.2, 0.0]]
    data = controller_data(grid) | {
        "cells": [{"low": [x, -1.5], "high": [y, 1.5]} for x, y in edges] * 3
    }
    page = node.run(
        """
        const controller = new Controller(input.controller);
        output = input.forces.map((force) => controller.step.nearestCell(force.map(Math.fround)));
        """,
        controller=data,
        forces=forces,
    )
    low, high = (
        np.array([cell[name] for cell in data["cells"]], np.float32) for name in ("low", "high")
    )
    step = dataclasses.replace(grid.step, low=low, high=high)
    singles = [np.array(force, np.float32) for force in forces]
    assert (
        page
        == [int(step.nearest_cell(select_operations(low), force)) for force in singles]
        == [0, 0, 1]
    )
