"""What is tuned for the paper's fin in newtons follows the size of any other fin.

The plants of these tests differ in the scale of their force alone, so gaits, policies and
corrections must be the same, and forces proportional.
"""

from functools import cache

import jax
import numpy as np
import pytest

from softfin.control.controller import Measured
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.pytrees import register_controllers
from softfin.control.references import default_references
from softfin.evaluation.headline import within
from softfin.evaluation.scores import SETTLED_N, settled_band, settling_times
from softfin.gaits.force_map import MapConfig, find_force_map
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import PAPER_REACH_N, PAPER_REFERENCES, Cell, Reachable
from softfin.gaits.search import GaitConfig
from softfin.gaits.simulate import SurveyConfig
from softfin.learning.configuration import TrainConfig, training_cells
from softfin.learning.ppo import PPO, PPOConfig
from softfin.task.references import PAPER_CELLS, stack_references
from softfin.task.task import ForceTracking
from tests.control.test_feedback import Carrier
from tests.plants import StrokeFin

GAIN = 0.9
SCALES = (0.05, 10.0)
"""Forces relative to those of a fin of the paper's size."""

QUICK_MAP = MapConfig(nodes=12, survey=SurveyConfig(pushes=2), gaits=GaitConfig(steps=4))


def circle(radius: float, centre: tuple[float, float] = (0.0, 0.0)) -> Reachable:
    return Reachable(np.array(centre, np.float32), np.full(32, radius, np.float32))


PAPER_SIZED = circle(PAPER_REACH_N, (PAPER_REACH_N, 0))


@cache
def mapped(scale: float) -> ForceMap:
    return find_force_map(StrokeFin(GAIN * scale), QUICK_MAP)


@pytest.mark.parametrize(
    ("reach_n", "size"),
    [(2.4, 1), (1.8, 1), (3.3, 1), (3.6, 2), (12, 5), (24, 10), (0.16, 0.05), (0.1, 0.05)],
)
def test_the_size_of_a_fin_is_one_two_or_five_in_its_decade(reach_n: float, size: float) -> None:
    corners = 32
    # A polygon is smaller than the circle through its corners.
    area = corners / 2 * np.sin(2 * np.pi / corners)
    region = circle(reach_n * np.sqrt(np.pi / area))
    assert region.reach_n == pytest.approx(reach_n, rel=1e-5)
    assert region.size == size


def test_a_fin_without_force_has_a_size_all_the_same() -> None:
    assert circle(0).size == 1


@pytest.mark.parametrize("across", [0.0, 0.02])
def test_the_size_of_a_fin_whose_forces_lie_on_a_line_follows_its_length(across: float) -> None:
    line = np.full(32, across, np.float32)
    line[[0, 16]] = 9.6
    region = Reachable(np.zeros(2, np.float32), line)
    assert region.reach_n == pytest.approx(2.4)
    assert region.size == 1
    ten = Reachable(np.zeros(2, np.float32), 10 * line)
    assert ten.size == 10


@pytest.mark.parametrize("scale", SCALES)
def test_a_map_has_the_same_gaits_for_forces_that_are_proportional(scale: float) -> None:
    usual = mapped(1.0)
    scaled = mapped(scale)
    assert scaled.gaits.table.nodes == usual.gaits.table.nodes
    assert scaled.reachable.size == usual.reachable.size * scale
    np.testing.assert_allclose(scaled.reachable.reach_n, scale * usual.reachable.reach_n, rtol=0.02)
    error = scaled.gaits.force_error() / scale
    assert np.median(error) < np.median(usual.gaits.force_error()) + 0.01
    np.testing.assert_allclose(
        scaled.gaits.table.references() / scale, usual.gaits.table.references(), atol=0.01
    )


@pytest.mark.parametrize("scale", SCALES)
def test_training_over_the_reach_learns_the_same_policy(scale: float) -> None:
    def first_update(scale: float) -> tuple[np.ndarray, float]:
        reachable = circle(PAPER_REACH_N * scale, (PAPER_REACH_N * scale, 0))
        config = TrainConfig(ppo=PPOConfig(num_envs=2, num_steps=6, num_minibatches=1))
        task = ForceTracking(StrokeFin(GAIN * scale), config.task.scaled(reachable.size))
        learner = PPO(task, config.ppo, config.policy, 1)
        references = stack_references(training_cells(config, reachable), reachable)
        agent = learner.init(jax.random.key(0), jax.tree.map(lambda x: x[0], references))
        agent, metrics = jax.jit(learner.update)(agent)
        return np.asarray(agent.networks.policy.net.hidden.kernel), float(metrics["reward"])

    kernel, reward = first_update(1.0)
    scaled_kernel, scaled_reward = first_update(scale)
    assert scaled_reward == pytest.approx(reward, rel=1e-3)
    np.testing.assert_allclose(scaled_kernel, kernel, atol=2e-3)


@pytest.mark.parametrize(
    "reachable",
    [
        circle(0.16, (0.16, 0)),
        circle(30, (20, 0)),
        circle(7.2, (0, 0)),
        circle(2, (-2, 0)),
        circle(0.02, (1, 1)),
    ],
)
def test_the_references_of_an_evaluation_are_six_that_the_fin_can_make(
    reachable: Reachable,
) -> None:
    references = default_references(reachable)
    assert len(set(references)) == 6
    assert reachable.contains(references).all()
    assert references != PAPER_REFERENCES
    # The farthest uses a good part of the reach.
    assert np.linalg.norm(references, axis=1).max() > 0.5 * reachable.reach_n


def test_the_references_are_the_papers_if_the_fin_can_make_them() -> None:
    assert default_references(None) == PAPER_REFERENCES
    assert default_references(PAPER_SIZED) == PAPER_REFERENCES


def test_the_references_are_the_papers_if_the_controller_was_trained_for_these_only() -> None:
    large = circle(7.2, (0, 0))
    assert default_references(large, PAPER_CELLS) == PAPER_REFERENCES
    everything = large.bounding_box()
    assert default_references(large, (everything,)) == default_references(large)
    # Trained for a part of the reach without the paper's references.
    part = Cell(low=(-1, -1), high=(1.5, 1))
    assert default_references(large, (part,)) == default_references(large)


def test_a_small_fin_has_to_settle_in_a_narrower_band() -> None:
    assert settled_band(None) == settled_band(PAPER_SIZED) == SETTLED_N
    assert settled_band(circle(0.24)) == pytest.approx(SETTLED_N / 10)
    reference = np.zeros((1500, 2))
    reference[500:] = (0.1, 0)
    force = reference.copy()
    force[500:] += 0.05
    (paper,) = settling_times(force, reference)
    (small,) = settling_times(force, reference, settled_band(circle(0.24)))
    assert np.isfinite(paper)
    assert np.isnan(small)


@pytest.mark.parametrize("scale", SCALES)
def test_force_feedback_corrects_a_proportional_error_by_as_much(scale: float) -> None:
    def corrections(scale: float) -> np.ndarray:
        reachable = circle(PAPER_REACH_N * scale)
        controller = Carrier(reachable, cells=(reachable.bounding_box(),))
        # The drift belongs to the sensor, so here the sensor is as small as the fin.
        feedback = Feedback(controller, FeedbackConfig(drift_n=0.05 * scale))
        state = feedback.init()
        tracked = []
        for action in range(60):
            force = state.tracked[-1] + np.array([0.15, -0.1]) * scale
            reference = (1.0 * scale, (1.0 if action < 40 else -1.0) * scale)
            state, _ = feedback.act(state, Measured(0.0, force), reference)
            tracked.append(state.tracked[-1] - np.array(reference))
        return np.array(tracked)

    usual = corrections(1.0)
    assert abs(usual[-1] + (0.15, -0.1)).max() < 0.1
    np.testing.assert_allclose(corrections(scale) / scale, usual, atol=1e-5)


def test_a_bound_has_as_many_decimals_as_the_size_needs() -> None:
    assert within(0.0712) == "0.08"
    assert within(0.00071, 4) == "0.0008"


def test_force_feedback_is_compiled_with_the_reach_of_its_controller() -> None:
    reachable = circle(PAPER_REACH_N / 10)
    register_controllers()
    feedback = Feedback(Carrier(reachable, cells=(reachable.bounding_box(),)))

    @jax.jit
    def widths(feedback: Feedback) -> jax.Array:
        force = jax.numpy.zeros(2)
        state, _ = feedback.act(feedback.init(), Measured(jax.numpy.float32(0), force), force)
        return jax.numpy.asarray(feedback.estimate(state).half_width)

    usual = Feedback(Carrier(circle(PAPER_REACH_N), cells=(Cell(low=(-3, -3), high=(3, 3)),)))
    np.testing.assert_allclose(widths(feedback), widths(usual) / 10, rtol=1e-4)
