import jax
import numpy as np
import pytest

from softfin.core.errors import LogError, RunError
from softfin.core.randomness import named_key
from softfin.storage.run_directory import LOG, RunDirectory, read_training_log
from softfin.surrogate.streaming import fit as module
from softfin.surrogate.streaming.ensemble import ensemble, single
from softfin.surrogate.streaming.fit import fit_streaming
from softfin.surrogate.streaming.profile import Profile
from softfin.surrogate.streaming.segments import measure_scales
from tests.full_disk import check_that_a_full_disk_stops, needs_full_device
from tests.surrogate.streaming import small

CONFIG = small.CONFIG
KNOWN = Profile(delay=2.5, acceleration=40.0)
"""Not quite, so that there is something left to learn."""

LOGS = [small.recorded(rows=400, seed=seed) for seed in range(4)]


@pytest.fixture(autouse=True)
def profile_known(monkeypatch):
    """Read off the logs in a test of its own: it takes seconds."""
    monkeypatch.setattr(module, "identify", lambda logs, seed: (KNOWN, 0.0))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A fit that was not interrupted, its log, and what it told on the way."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "identify", lambda logs, seed: (KNOWN, 0.0))
        run_directory = RunDirectory(tmp_path_factory.mktemp("whole") / "s", {"a": 1})
        seen = []
        fitted = fit_streaming(
            LOGS, CONFIG, 0, run_directory, lambda stage, done, note: seen.append((done, note))
        )
        return fitted, read_training_log(run_directory.folder / LOG), seen


def of(name, history):
    """One scalar of a training log, where it is."""
    return [entry[name] for entry in history if name in entry]


class Killed(BaseException):
    pass


def same(one, other):
    return all(
        np.array_equal(a, b) for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True)
    )


@pytest.mark.parametrize(("after", "from_then_on"), [(0.3, 0.1), (0.7, 0.5)])
def test_a_killed_fit_resumes_to_the_same_surrogate(tmp_path, whole, after, from_then_on):
    """Killed while the drive networks learn, and while the force networks do."""

    def killer(stage, done, note):
        if done > after:
            raise Killed

    with pytest.raises(Killed):
        fit_streaming(LOGS, CONFIG, 0, RunDirectory(tmp_path / "cut", {"a": 1}), killer)
    resumed_from = []
    run_directory = RunDirectory(tmp_path / "cut", {"a": 1}, resume=True)
    resumed = fit_streaming(
        LOGS, CONFIG, 0, run_directory, lambda stage, done, note: resumed_from.append(done)
    )
    assert min(resumed_from) > from_then_on
    surrogate, history, _ = whole
    assert same(surrogate, resumed)
    assert (resumed.interval, resumed.limits) == (surrogate.interval, surrogate.limits)
    assert read_training_log(run_directory.folder / LOG) == history
    assert [entry["step"] for entry in history] == list(range(1, 21))


def test_every_weight_learns_but_the_profile_which_is_what_the_logs_say(whole):
    surrogate, _, _ = whole
    scales = measure_scales(LOGS[:-1])
    fresh = ensemble(2, CONFIG.drive, CONFIG.force, scales, named_key(0, "fit/weights"))
    before, after = (
        dict(jax.tree_util.tree_leaves_with_path(nets)) for nets in (fresh, surrogate.members)
    )
    held = [
        jax.tree_util.keystr(path)
        for path in before
        if before[path].size and same(before[path], after[path])
    ]
    assert all(name.startswith(".drive.profile.") for name in held)
    for index in range(2):
        assert same(single(surrogate.members.drive.profile, index), KNOWN)


def test_the_members_are_not_alike(whole):
    one, other = (single(whole[0].members, index) for index in range(2))
    alike = [
        np.array_equal(a, b)
        for a, b in zip(*map(jax.tree.leaves, (one.force.core, other.force.core)), strict=True)
    ]
    assert not any(alike)


def test_the_best_weights_of_each_member_are_kept(whole):
    surrogate, history, _ = whole
    (said,) = small.predict_logs(surrogate.members, LOGS[-1:])
    error = (said.force - LOGS[-1].reading.force)[:, CONFIG.burn_in :]
    assert np.mean(np.sum(error**2, axis=-1)) <= min(of("held_out/force_mse", history)) * 1.001


def test_limits_are_the_range_of_the_training_commands(whole):
    limits = whole[0].limits
    command = [log.command for log in LOGS[:-1]]
    angle, velocity = (np.concatenate([c[i] for c in command]) for i in range(2))
    assert limits == pytest.approx((angle.min(), angle.max(), velocity.min(), velocity.max()))


def test_held_out_logs_reach_no_weight(tmp_path, whole):
    last = LOGS[-1]
    strange = last._replace(
        reading=last.reading._replace(force=last.reading.force * np.float32(1e-6))
    )
    run_directory = RunDirectory(tmp_path / "s", {})
    fit_streaming([*LOGS[:-1], strange], CONFIG, 0, run_directory)
    both = whole[1], read_training_log(run_directory.folder / LOG)
    assert of("train/force_loss", both[0]) == of("train/force_loss", both[1])
    assert of("held_out/force_mse", both[0]) != of("held_out/force_mse", both[1])


@pytest.mark.parametrize(
    ("logs", "changes", "words"),
    [
        (LOGS[:1], [], "held-out logs: none of 1 .* 210 rows"),
        (LOGS, ["ticks=390"], "training logs: .* 411 .*--ticks N"),
        ([*LOGS[:2], small.valid_rows(LOGS[2], 0, 209)], [], "held-out logs: .* 210 rows"),
    ],
)
def test_logs_that_are_too_few_or_too_short_are_refused(tmp_path, logs, changes, words):
    with pytest.raises(LogError, match=words):
        fit_streaming(logs, CONFIG.changed(changes), 0, RunDirectory(tmp_path / "s", {}))


def test_a_loss_that_explodes_stops_the_fit(tmp_path, monkeypatch):
    def far_off(*parts):
        return jax.tree.map(lambda x: x + np.float32(1e30), ensemble(*parts))

    monkeypatch.setattr(module, "ensemble", far_off)
    with pytest.raises(RunError, match="drive networks is NaN or infinite; lower --learning-rate"):
        fit_streaming(LOGS, CONFIG, 0, RunDirectory(tmp_path / "s", {}))


def test_progress_never_goes_back_and_ends_at_1(whole):
    _, _, seen = whole
    assert [done for done, _ in seen] == pytest.approx(np.arange(21) / 20)
    assert [note.split(" networks")[0] for _, note in seen[1:]] == ["drive"] * 10 + ["force"] * 10


@pytest.mark.parametrize("updates", [1, 10, 25, 600, 601, 610, 1000, 2000, 5003])
def test_all_calls_but_the_very_last_are_equal(updates):
    call, round_of = module._calls(updates)
    assert 1 <= call <= module.UPDATES_A_CALL
    assert round_of % call == 0
    assert -(-updates // round_of) <= module.MAX_SCORINGS


@needs_full_device
def test_a_full_disk_stops_the_fit_with_an_error(tmp_path):
    run_directory = RunDirectory(tmp_path / "s", {})
    check_that_a_full_disk_stops(
        lambda: fit_streaming(LOGS, CONFIG, 0, run_directory), run_directory.folder
    )
