import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.core.plant import Plant
from softfin.core.quantities import Command, Limits
from softfin.evaluation.experiment import ExperimentRecording, independent, run
from softfin.evaluation.scores import judged_force, score
from tests.plants import AnalyticFin, Flapper, MisreadFin, PlainFin

REFERENCES = np.array([[1, -1], [2, 0], [3, 1]], np.float32)
KEYS = jax.random.split(jax.random.key(0), 2)
ENDS = np.array([33, 66, 100, 133, 166, 200])


class Echo(eqx.Module):
    """Commands the angle it was given, and the reference force, shifted into what a plant takes."""

    gain: jax.Array = eqx.field(default_factory=lambda: jnp.float32(0.1))

    def init(self):
        return ()

    def act(self, state, measured, reference):
        return state, Command(
            measured.angle + self.gain * reference[0], 2 + self.gain * reference[1]
        )

    def check(self, reference):
        """Covers everything."""


@pytest.fixture(scope="module")
def recording() -> ExperimentRecording:
    return run(Echo(), AnalyticFin(), REFERENCES, 2, KEYS)


def test_everything_is_recorded_every_10_ms(recording):
    assert recording.command.angle.shape == recording.reading.angle.shape == (3, 2, 200)
    assert recording.reading.force.shape == (3, 2, 200, 2)
    np.testing.assert_allclose(recording.reading.time[1, 1], np.arange(1, 201) / 100, rtol=1e-6)
    np.testing.assert_array_equal(recording.reference, REFERENCES)


def test_commands_change_after_33_33_and_34_ticks(recording):
    changes = np.flatnonzero(np.diff(recording.command.angle[0, 0])) + 1
    np.testing.assert_array_equal(changes, ENDS[:-1])


def test_each_action_sees_the_last_reading_and_the_first_sees_rest(recording):
    starts = np.r_[0, ENDS[:-1]]
    seen = recording.command.angle[..., starts] - 0.1 * REFERENCES[:, :1, None]
    np.testing.assert_allclose(seen[..., 0], 0, atol=1e-6)
    np.testing.assert_allclose(
        seen[..., 1:], recording.reading.angle[..., ENDS[:-1] - 1], atol=1e-6
    )


def test_a_fin_whose_range_excludes_0_is_seen_at_its_rest():
    fin = PlainFin()
    fin.limits = Limits(0.5, 1.5, 1.0, 3.0)
    recording = run(Echo(), fin, REFERENCES, 1, KEYS)
    seen = np.asarray(recording.command.angle[..., 0]) - 0.1 * REFERENCES[:, :1]
    np.testing.assert_allclose(seen, 0.5, atol=1e-6)


def test_each_experiment_has_its_own_reference(recording):
    np.testing.assert_allclose(
        recording.command.velocity[:, 1, 150], 2 + 0.1 * REFERENCES[:, 1], rtol=1e-6
    )


def test_seeds_differ_in_the_plants_randomness_alone(recording):
    assert (recording.reading.force[0, 0] != recording.reading.force[0, 1]).any()
    np.testing.assert_array_equal(recording.reading.angle[0, 0], recording.reading.angle[0, 1])


def test_side_by_side_equals_one_at_a_time(recording):
    for i in range(3):
        alone = run(Echo(), AnalyticFin(), REFERENCES[i : i + 1], 2, KEYS[1:])
        np.testing.assert_allclose(
            alone.reading.force[0, 0], recording.reading.force[i, 1], atol=1e-5
        )


def test_a_controller_keeps_its_memory_from_action_to_action():
    recording = run(Flapper(), AnalyticFin(), REFERENCES[:1], 2, KEYS[:1])
    np.testing.assert_allclose(
        recording.command.angle[0, 0, ENDS - 1], 0.8 * np.array([1, -1] * 3), rtol=1e-6
    )


def test_a_plant_may_be_any_object():
    plant = PlainFin()
    assert isinstance(plant, Plant)
    plain = run(Flapper(), plant, REFERENCES[:1], 1, KEYS[:1])
    module = run(Flapper(), AnalyticFin(), REFERENCES[:1], 1, KEYS[:1])
    np.testing.assert_allclose(plain.reading.force, module.reading.force, atol=1e-5)


def test_a_reference_that_moves_is_seen_as_it_is_when_the_controller_acts():
    moving = np.cumsum(np.ones((1, 200, 2)), axis=1).astype(np.float32) / 1000
    recording = run(Echo(), AnalyticFin(), moving, 2, KEYS[:1])
    starts = np.r_[0, ENDS[:-1]]
    wanted = np.repeat(2 + 0.1 * moving[0, starts, 1], np.diff(np.r_[0, ENDS]))
    np.testing.assert_allclose(recording.command.velocity[0, 0], wanted, rtol=1e-6)
    np.testing.assert_array_equal(recording.reference, moving)


def test_a_moving_reference_of_another_length_is_refused():
    moving = np.repeat(REFERENCES[:1, None], 150, axis=1)
    with pytest.raises(ValueError, match="got 150 references; must be one per tick of 2 s"):
        run(Echo(), AnalyticFin(), moving, 2, KEYS[:1])


def test_a_moving_reference_that_stays_does_as_a_constant_one(recording):
    stays = np.repeat(REFERENCES[:, None], 200, axis=1)
    np.testing.assert_allclose(
        run(Echo(), AnalyticFin(), stays, 2, KEYS).reading.force, recording.reading.force, atol=1e-6
    )


def test_the_true_force_is_recorded_where_a_plant_knows_it_and_judges():
    recording = run(Flapper(), MisreadFin(), REFERENCES, 4, KEYS)
    offset = np.asarray(recording.reading.force - recording.true_force)
    np.testing.assert_allclose(offset, np.broadcast_to([0.4, 0.0], offset.shape), atol=1e-5)
    assert recording.first().true_force.shape == (3, 1, 400, 2)
    scores = score(recording)
    truth = score(run(Flapper(), PlainFin(), REFERENCES, 4, KEYS))
    np.testing.assert_allclose(scores.error, truth.error, atol=1e-4)
    assert np.abs(scores.reading_error[..., 0] - scores.error[..., 0]).max() > 0.1
    assert judged_force(recording) == "true force"


def test_a_plant_with_readings_alone_is_judged_by_them(recording):
    assert recording.true_force is None
    assert score(recording).reading_error is None
    assert judged_force(recording) == "reading"


class Unsure(MisreadFin):
    """Its sensor reads on where the true force has become infinite."""

    def true_force(self, state):
        fin, force = state
        return jnp.where(fin.ticks > 150, jnp.inf, force)


def test_a_true_force_that_is_not_finite_is_an_error():
    recording = run(Flapper(), Unsure(), REFERENCES, 4, KEYS)
    assert np.isfinite(recording.reading.force).all()
    with pytest.raises(
        PlantError, match=r"seed 0, 1\.51 s: true force is not finite after the command"
    ):
        independent(recording)
