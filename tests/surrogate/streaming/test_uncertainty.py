import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.quantities import Command, Log, Reading
from softfin.core.window import window_means
from softfin.surrogate.streaming.ensemble import (
    Interval,
    calibrated,
    familiar,
    predict_motion,
    remembered,
    single,
)
from tests.surrogate.streaming import small

BURN_IN = 7


def test_the_floor_is_the_noise_of_the_mean_force():
    """White noise averages out over a window, and an offset of each log, like a drift, does not."""
    random = np.random.default_rng(0)
    shape = (3, 20 * PAPER_CLOCK.window_ticks, 2)
    for white_n, offset_n, floor_n in ((0.5, 0.0, 0.5 / np.sqrt(200)), (0.5, 0.3, 0.3)):
        logs = []
        for noise in random.normal(0, white_n, shape):
            log = log_of(np.zeros((20, 2)))
            offset = np.array([offset_n, -offset_n])
            force = np.asarray(log.reading.force) + np.pad(noise + offset, ((7, 5), (0, 0)))
            logs.append(log._replace(reading=log.reading._replace(force=force)))
        said = [said_of([np.zeros((20, 2))])] * 3
        assert calibrated(said, logs, BURN_IN).floor_n == pytest.approx(floor_n, rel=0.15)


def log_of(means):
    """With these mean forces in its windows, behind the burn-in."""
    force = np.concatenate(
        [
            np.full((7, 2), 99.0),
            np.repeat(means, PAPER_CLOCK.window_ticks, axis=0),
            np.full((5, 2), 99.0),
        ]
    )
    rows = np.zeros(len(force), np.float32)
    return Log(Command(rows, rows), Reading(rows, rows, rows, force.astype(np.float32)))


def said_of(members):
    return np.stack([np.asarray(log_of(means).reading.force) for means in members])


def test_means_are_those_of_whole_windows_behind_the_burn_in():
    means = np.arange(8.0).reshape(4, 2)
    np.testing.assert_allclose(window_means(said_of([means, -means])[:, 7:]), [means, -means])


@pytest.mark.parametrize("windows", [10, 200])
def test_the_interval_holds_its_share_of_errors_that_it_was_not_calibrated_with(windows):
    """Members that disagree more where they are more wrong; so few logs, of a window each, that one
    more is seen."""
    random = np.random.default_rng(windows)
    held = []
    for _ in range(300):
        size = random.uniform(0.1, 1.0, (windows + 50, 2))
        error = random.normal(0, 0.3, size.shape) * size
        spread = 0.3 * size
        members = [error + spread, error - spread]
        found = (
            calibrated(
                [said_of([m[i : i + 1] for m in members]) for i in range(windows)],
                [log_of(np.zeros((1, 2)))] * windows,
                BURN_IN,
            )
            if windows == 10 or len(held) < 10
            else found
        )
        fresh = np.stack(members)[:, windows:]
        held.append(np.mean(np.abs(fresh.mean(axis=0)) <= found.half_width(fresh)))
    assert 0.895 <= np.mean(held) <= (0.96 if windows == 10 else 0.93)
    assert found.windows == 2 * windows


@pytest.mark.parametrize("logs", [1, 2, 5])
def test_the_interval_holds_its_share_where_the_errors_of_a_log_are_all_its_drift(logs):
    """On average over calibrations: from few logs it is wider, for its scale is known from few
    drifts alone."""
    random = np.random.default_rng(logs)
    held = []
    for _ in range(400):
        drifts = np.repeat(random.normal(0, 0.05, (logs + 20, 1, 2)), 3, axis=1)
        means = drifts + random.normal(0, 0.01, drifts.shape)
        found = calibrated(
            [said_of([np.zeros((3, 2))] * 2)] * logs, [log_of(m) for m in means[:logs]], BURN_IN
        )
        held.append(np.mean(np.abs(means[logs:]) <= found.half_width(np.zeros((2, 20, 3, 2)))))
    assert 0.88 <= np.mean(held) <= 0.95


def test_the_half_width_grows_with_the_spread_of_the_members():
    found = Interval(coverage=0.9, factor=2.0, floor_n=0.3, windows=10, logs=10)
    spreads = np.array([0.0, 0.4, 4.0])
    widths = found.half_width(np.stack([1 + spreads, 1 - spreads]))
    np.testing.assert_allclose(widths, 2 * np.sqrt(spreads**2 + 0.09))


@pytest.fixture(scope="module")
def known():
    """Training logs of slow commands to small angles, and distances of the memories of such
    logs."""
    members = small.members(seed=3, spread=0.3)
    return members, familiar(
        members.force,
        predict_motion(members.drive, [training(seed) for seed in range(6)]),
        burn_in=100,
    )


def training(seed, **options):
    return small.recorded(1500, seed, reach=0.5, speeds=(1.0, 1.5), **options)


def distances(known, log):
    """Tick by tick along the commands of a log, behind a burn-in."""
    members, familiarity = known
    member = single(members)
    waiting = jax.tree.map(lambda x: jnp.full(20, x[0]), log.command)

    def step(state, command):
        state, _ = member.step(state, Command(*command))
        return state, familiarity.distance(remembered(state.force))

    start = member.start(small.rows_of_first(log), waiting)
    return np.asarray(
        jax.jit(lambda commands: jax.lax.scan(step, start, commands)[1])(log.command)
    )[100:]


def test_one_in_a_thousand_moments_of_the_training_data_is_further_than_1(known):
    along = np.concatenate([distances(known, training(seed)) for seed in range(6)])
    assert 0.0002 < np.mean(along > 1) < 0.004


def test_commands_that_were_never_trained_are_far(known):
    fast = distances(known, small.recorded(600, 9, reach=1.5, speeds=(3.0, 3.1)))
    usual = distances(known, training(20))
    assert np.median(fast) > 1.5 * np.median(usual)
    assert np.mean(fast > 1) > 0.2
    assert np.mean(usual > 1) < 0.02


@pytest.mark.parametrize(
    ("logs", "said"), [(10, None), (9, "9 held-out logs and"), (1, "1 held-out log and")]
)
def test_an_interval_from_few_logs_says_that_it_hardly_covers_them(logs, said):
    caveat = small.interval().model_copy(update={"logs": logs}).caveat()
    assert (caveat is None) if said is None else said in caveat
