import json

import jax
import numpy as np
import pytest

from softfin.core.errors import ArtifactError, LogError
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import AutoConfig, FitConfig, StreamingSurrogate, Surrogate
from softfin.surrogate import selection as choice
from softfin.surrogate.compare.scores import free_run, segments_of, take
from softfin.surrogate.selection import fit_any
from softfin.surrogate.streaming import fit as module
from softfin.surrogate.streaming.segments import scales_of
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

PAPER = FitConfig(posnet=paper.POSNET, forcenet=paper.FORCENET, epochs=1, batch=64)
CONFIG = AutoConfig(
    paper=PAPER,
    streaming=small.CONFIG.changed(
        ["drive_updates=1", "force_updates=200", "learning_rate=0.03", "members=1", "force.units=2", "drive.units=2"]
    ),
)


SCALES = scales_of([small.recorded(rows=600, seed=seed, noise_n=0.05) for seed in range(3)])


def paper_fit(logs, config, seed, run_directory, progress=None):
    """As if they had learnt nothing: to compile them takes longer than all else."""
    if progress is not None:
        progress("fit", 1.0, "done")
    return paper.surrogate()


@pytest.fixture(autouse=True)
def profile_known(monkeypatch):
    monkeypatch.setattr(module, "identify", lambda logs, seed: (small.PROFILE, 0.0))
    # The same for all logs, so that one program fits to any of them.
    monkeypatch.setattr(module, "scales_of", lambda logs: SCALES)
    monkeypatch.setattr("softfin.surrogate.selection.fit", paper_fit)


def logs():
    return [small.recorded(rows=600, seed=seed, noise_n=0.05) for seed in range(4)]


@pytest.mark.slow
def test_the_candidate_with_the_least_error_on_held_out_logs_is_kept(tmp_path):
    data, run_directory, notes = logs(), RunDirectory(tmp_path / "s", {}), []
    fitted, evidence = fit_any(data, CONFIG, 0, run_directory, lambda stage, done, note: notes.append((done, note)))
    assert evidence["chosen"] == "streaming"
    scores = evidence["held_out"]
    assert list(scores) == ["streaming", "paper"]
    assert scores["streaming"] == min(scores.values(), key=lambda score: score["force_rmse_n"])
    assert type(fitted) is StreamingSurrogate

    where = segments_of([600], 300, 300)
    said, measured = free_run(fitted, data[-1:], where, 300)[0], take(data[-1:], where, 300).reading
    assert scores["streaming"]["force_rmse_n"] == pytest.approx(
        np.sqrt(np.mean((said.force - measured.force) ** 2)), rel=1e-4
    )
    assert scores["streaming"]["seconds"] == 3.0
    assert json.loads(json.dumps(evidence)) == evidence
    assert [done for done, _ in notes] == sorted(done for done, _ in notes)
    assert notes[-1][0] == pytest.approx(1.0)
    assert notes[-1][1].startswith("paper: ")


def test_the_kind_of_configuration_says_which_model(tmp_path, monkeypatch):
    monkeypatch.setattr("softfin.surrogate.selection.fit_streaming", lambda *words: small.surrogate())
    for config, kind in ((PAPER, Surrogate), (small.CONFIG, StreamingSurrogate)):
        fitted, evidence = fit_any(logs(), config, 0, RunDirectory(tmp_path / "s", {}))
        assert type(fitted) is kind
        assert evidence is None


def test_logs_on_which_nothing_can_be_compared_are_refused_before_anything_is_fitted(tmp_path, monkeypatch):
    def no_fit(*words):
        raise AssertionError

    monkeypatch.setattr("softfin.surrogate.selection.fit_streaming", no_fit)
    short = [small.rows_of(log, 0, 300) for log in logs()]
    with pytest.raises(LogError, match="held-out log 0: 300 rows; more than a window of 300 are needed"):
        fit_any(short, CONFIG, 0, RunDirectory(tmp_path / "s", {}))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ([], "column command_velocity_rad_s is 2 in every training row"),
        (["paper.batch=5000"], "1764 training windows are fewer than one batch of 5000"),
        (["streaming.ticks=590"], "611 are needed in one piece"),
    ],
)
def test_logs_that_one_candidate_cannot_be_fitted_to_are_refused(tmp_path, monkeypatch, change, reason):
    def no_fit(*words):
        raise AssertionError

    monkeypatch.setattr("softfin.surrogate.selection.fit_streaming", no_fit)
    data = logs()
    if not change:
        data = [log._replace(command=log.command._replace(velocity=np.full(600, 2, np.float32))) for log in data]
    with pytest.raises(LogError, match=reason):
        fit_any(data, CONFIG.changed(change), 0, RunDirectory(tmp_path / "s", {}))


def test_logs_that_fit_no_candidate_are_refused_in_the_words_of_the_first(tmp_path):
    with pytest.raises(LogError, match="1 training log: at least 2 are needed"):
        fit_any(logs()[:1], CONFIG, 0, RunDirectory(tmp_path / "s", {}))


@pytest.fixture
def silent(monkeypatch):
    """A surrogate that says zero: its error is what was measured."""

    def free_run(surrogate, logs, where, ticks):
        measured = take(logs, where, ticks).reading
        return jax.tree.map(np.zeros_like, measured), None

    monkeypatch.setattr("softfin.surrogate.selection.free_run", free_run)


@pytest.mark.usefixtures("silent")
def test_each_log_counts_over_its_own_length():
    """Of 40 s a stretch of 30 s, of 15 s and 5 s all that is behind the first 2 s."""
    data = [small.recorded(rows, seed) for seed, rows in enumerate((4000, 1500, 500))]
    scores = choice._scores(small.surrogate(), data, 200)
    used = [data[0].reading.force[200:3200], data[1].reading.force[200:], data[2].reading.force[200:]]
    assert scores["seconds"] == 30 + 13 + 3
    assert scores["force_rmse_n"] == pytest.approx(np.sqrt(np.mean(np.concatenate(used) ** 2)), rel=1e-5)


def test_a_killed_choice_is_neither_lost_nor_begun_anew(tmp_path, monkeypatch):
    """As long as it had not come to the end its checkpoints lie in parts alone."""
    begun, data = [], logs()

    def killed_midway(logs, config, seed, run_directory, progress=None):
        begun.append(run_directory.load({"x": np.zeros(1)}))
        run_directory.save({"x": np.ones(1)}, {"step": 1})
        if len(begun) == 2:
            raise KeyboardInterrupt
        return small.surrogate()

    for name in ("fit", "fit_streaming"):
        monkeypatch.setattr(f"softfin.surrogate.selection.{name}", killed_midway)
    with pytest.raises(KeyboardInterrupt):
        fit_any(data, CONFIG, 0, RunDirectory(tmp_path / "s", {"seed": 0}))
    with pytest.raises(ArtifactError, match="holds an unfinished run; go on with --resume"):
        RunDirectory(tmp_path / "s", {"seed": 0})
    with pytest.raises(ArtifactError, match=r"is of another run .seed was 0 and is 1"):
        RunDirectory(tmp_path / "s", {"seed": 1}, resume=True)
    fit_any(data, CONFIG, 0, RunDirectory(tmp_path / "s", {"seed": 0}, resume=True))
    assert [before is not None for before in begun] == [False, False, True, True]
