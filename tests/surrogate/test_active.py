import functools
import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS, Command, Limits
from softfin.data.excitation import ExcitationConfig
from softfin.surrogate import StreamingSurrogate, save_surrogate
from softfin.surrogate.active import ActiveCollectConfig, ActiveConfig, Chooser, chooser, information, unlikeness
from softfin.surrogate.streaming.ensemble import Familiarity, Interval, ensemble, remembered, single
from softfin.surrogate.streaming.fit import StreamingConfig
from softfin.surrogate.streaming.segments import Motion, Scales
from tests.surrogate import small

CONFIG = ActiveConfig(candidates=8, piece_s=1.0)
SHORT = ExcitationConfig(hold_min_s=0.3, hold_max_s=0.5)
ROWS = 401
NOVEL = CONFIG.model_copy(update={"novelty": 0.0})
NARROW = Limits(-0.5, 0.9, 1.2, 2.0)


@functools.cache
def two_members():
    """They agree on slow strokes, and less and less the faster they are."""
    config = StreamingConfig()
    scales = Scales(angle_rad=0.8, velocity_rad_s=2.0, change_rad_s=0.25, force_n=2.0)
    drive, force = (part.model_copy(update={"units": 4, "hidden": 4}) for part in (config.drive, config.force))
    nets = ensemble(2, drive, force, scales, jax.random.key(0))
    return eqx.tree_at(lambda nets: nets.force.thrust, nets, jnp.asarray([[0.0, 0.0], [1.0, 0.0]]))


@functools.cache
def streaming(members: int = 2, limits: Limits = PAPER_LIMITS) -> StreamingSurrogate:
    """Of the first so many of them."""
    nets = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[:members]), two_members())
    size = remembered(single(nets.force).start(Motion(jnp.zeros(()), jnp.zeros(())))).size
    interval = Interval(coverage=0.9, factor=1.6, floor_n=0.05, windows=1, logs=10)
    return StreamingSurrogate(nets, limits, interval, Familiarity(jnp.zeros(size), jnp.eye(size)))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("ensembles")
    save_surrogate(root / "paper", small.surrogate(), None, {})
    save_surrogate(root / "alone", streaming(1), None, {})
    save_surrogate(root / "ensemble", streaming(), None, {"data_hash": "d"})
    save_surrogate(root / "narrow", streaming(limits=Limits(-0.3, 0.3, 1.0, 3.0)), None, {})
    return root


@functools.cache
def making(config, rows, limits, excitation):
    make = Chooser(streaming(), config, excitation)
    return jax.jit(lambda key: make(key, rows, limits))


def chosen(config=CONFIG, rows=ROWS, seed=0, limits=PAPER_LIMITS, excitation=SHORT):
    return making(config, rows, limits, excitation)(jax.random.key(seed))


@jax.jit
def rolled(commands):
    """The members' forces."""
    plant = streaming()

    def tick(state, command):
        state, each = plant.advance_members(state, command, 1)
        return state, each.force[:, 0]

    return jax.lax.scan(tick, plant.init(jax.random.key(0)), commands)[1]


def disagreement(commands) -> float:
    return float(rolled(commands).var(axis=1).mean())


def test_there_is_one_command_a_row_and_all_are_within_the_limits():
    commands = chosen(NOVEL, limits=NARROW)
    assert commands.angle.shape == commands.velocity.shape == (ROWS,)
    assert NARROW.angle_min <= commands.angle.min() < commands.angle.max() <= NARROW.angle_max
    assert NARROW.velocity_min <= commands.velocity.min() < commands.velocity.max() <= NARROW.velocity_max


def test_members_disagree_more_on_the_chosen_commands_than_on_random_ones():
    many = [disagreement(chosen(seed=seed)) for seed in range(3)]
    one = [disagreement(chosen(CONFIG.model_copy(update={"candidates": 1}), seed=seed)) for seed in range(3)]
    assert min(many) > 1.2 * max(one)


def test_the_same_key_gives_the_same_commands_and_another_key_others():
    first, again, other = chosen(), chosen(), chosen(seed=1)
    np.testing.assert_array_equal(first.angle, again.angle)
    assert not np.array_equal(first.angle, other.angle)


def test_no_command_is_held_shorter_than_the_shortest_hold():
    lengths = [np.diff(np.r_[-1, np.flatnonzero(np.diff(np.asarray(chosen(seed=s).angle)))]) for s in range(8)]
    shortest = round(SHORT.hold_min_s * 100)
    assert shortest <= np.concatenate(lengths).min() < shortest + 3


def test_a_piece_goes_on_from_where_the_one_before_has_led():
    """Of the candidates for the second piece, rolled from rest behind the first, the most telling one was taken."""
    commands = jax.tree.map(np.asarray, chosen(NOVEL, limits=NARROW))
    keys = jax.random.split(jax.random.fold_in(jax.random.key(0), 1), NOVEL.candidates)
    maker = Chooser(streaming(), NOVEL, SHORT)
    rivals = jax.jit(jax.vmap(lambda key: maker._sequence(key, NARROW)))(keys)
    told = []
    for index in range(NOVEL.candidates):
        # As long as all that is rolled here, so that one program does it; what comes behind the piece is not looked at.
        parts = [(first[:100], np.asarray(own[index])) for first, own in zip(commands, rivals, strict=True)]
        held = Command(*(np.pad(np.concatenate(part), (0, ROWS - 200), mode="edge") for part in parts))
        force = np.asarray(rolled(held))[100:200]
        told.append(float(information(jnp.asarray(force.reshape(4, 25, 2, 2).mean(axis=1)), NOVEL.noise_n)))
    np.testing.assert_array_equal(commands.angle[100:200], rivals.angle[int(np.argmax(told))])


def test_information_is_none_where_all_agree_and_half_a_logarithm_of_signal_over_noise_elsewhere():
    agreed = jnp.full((4, 3, 2), 1.7)
    assert information(agreed, 0.05) < 1e-6
    one = agreed.at[2, :, 0].add(jnp.array([-0.3, 0.0, 0.3]))
    np.testing.assert_allclose(information(one, 0.1), 0.5 * np.log(1 + 0.06 / 0.01), rtol=1e-5)


def test_a_piece_is_unlike_by_its_distance_to_the_nearest_visited():
    memory = jnp.array([[0.0, 0.0], [3.0, 0.0]])
    nowhere = jnp.full((2, 2, 2), jnp.inf)
    assert unlikeness(memory, nowhere) == 1
    visited = nowhere.at[0].set(jnp.array([[0.0, 1.0], [3.0, 4.0]]))
    assert unlikeness(memory, visited) == pytest.approx((1 + np.sqrt(10)) / 2)


def test_what_chose_is_told_with_the_data_it_was_fitted_to(folders):
    _, metadata = chooser(folders / "ensemble", ActiveCollectConfig(), PAPER_LIMITS)
    assert metadata == {"surrogate": str(folders / "ensemble"), "members": 2, "data_hash": "d"}
    assert json.dumps(metadata)


@pytest.mark.parametrize(
    ("name", "limits", "words"),
    [
        ("paper", PAPER_LIMITS, "paper: a paper surrogate; active excitation needs members that can disagree: fit one"),
        ("alone", PAPER_LIMITS, "alone: a streaming surrogate; active excitation needs members that can"),
        (
            "narrow",
            PAPER_LIMITS,
            "narrow: learnt from commands with angles of -0.3 .. 0.3 rad, where the plant takes -1.57 .. 1.57; "
            "it must have learnt from at least 50% of that and nothing beyond: fit it to random logs of this plant",
        ),
        (
            "ensemble",
            Limits(-1.0, 1.0, 1.0, 3.1),
            "ensemble: learnt from commands with angles of -1.57 .. 1.57 rad, where the plant takes -1 .. 1; it must "
            "have learnt from at least 50% of that and nothing beyond: fit it to random logs of this plant",
        ),
    ],
)
def test_an_ensemble_that_cannot_choose_is_refused(folders, name, limits, words):
    with pytest.raises(ConfigurationError, match=words.replace("(", r"\(").replace(".", r"\.")):
        chooser(folders / name, ActiveCollectConfig(), limits)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ("active.window_s=0.255", "window_s must be whole samples of 10 ms"),
        ("active.piece_s=1.1", "and piece_s whole windows"),
        ("active.candidates=0", "greater than 0"),
        ("active.novelti=1", "did you mean 'novelty'"),
        ("excitation.hold_min_s=2.5", r"hold_max_s = 1\.5 must be at least"),
    ],
)
def test_choices_that_make_no_sense_are_refused(change, words):
    with pytest.raises(ConfigurationError, match=words):
        ActiveCollectConfig().changed([change])


def test_a_piece_holds_at_least_the_shortest_hold():
    with pytest.raises(ConfigurationError, match=r"active\.piece_s = 0\.25 must be at least excitation\.hold_min_s"):
        ActiveCollectConfig().merged({"active": {"piece_s": 0.25}, "excitation": {"hold_min_s": 0.3}}, "test")
