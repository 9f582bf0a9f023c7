import json

import numpy as np
import pytest

from softfin.checkpoint import LOG, Workspace, read_log
from softfin.errors import LogError
from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig, StreamingSurrogate, Surrogate
from softfin.surrogate.choice import fit_any
from softfin.surrogate.horizons import free_running, places, take
from softfin.surrogate.streaming import fit as module
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

PAPER = FitConfig(posnet=paper.POSNET, forcenet=paper.FORCENET, epochs=1, batch=64)
CONFIG = AutoConfig(
    paper=PAPER,
    streaming=small.CONFIG.changed(
        ["drive_updates=1", "force_updates=200", "learning_rate=0.03", "members=1", "force.units=2", "drive.units=2"]
    ),
)


def paper_fit(logs, config, seed, workspace, progress=None):
    """As if they had learnt nothing: to compile them takes longer than all else."""
    if progress is not None:
        progress("fit", 1.0, "done")
    return paper.surrogate()


@pytest.fixture(autouse=True)
def profile_known(monkeypatch):
    monkeypatch.setattr(module, "identify", lambda logs, seed: (small.PROFILE, 0.0))
    monkeypatch.setattr("softfin.surrogate.choice.fit", paper_fit)


def logs(sided):
    return [small.recorded(rows=600, seed=seed, sided=sided, noise_n=0.05) for seed in range(4)]


@pytest.mark.slow
@pytest.mark.parametrize(("sided", "chosen"), [(False, "streaming"), (True, "streaming, no symmetry")])
def test_the_candidate_with_the_least_error_on_held_out_logs_is_kept(tmp_path, sided, chosen):
    """A fin whose thrust has a sign is none that a mirror leaves as it is."""
    data, workspace, notes = logs(sided), Workspace(tmp_path / "s", {}), []
    fitted, evidence = fit_any(data, CONFIG, 0, workspace, lambda stage, done, note: notes.append((done, note)))
    assert evidence["chosen"] == chosen
    scores = evidence["held_out"]
    assert list(scores) == ["streaming", "streaming, no symmetry", "paper"]
    assert scores[chosen] == min(scores.values(), key=lambda score: score["force_rmse_n"])
    assert fitted.members.force.config.mirror == (chosen == "streaming")

    where = places([600], 300, 300)
    said, measured = free_running(fitted, data[-1:], where, 300).reading, take(data[-1:], where, 300).reading
    assert scores[chosen]["force_rmse_n"] == pytest.approx(
        np.sqrt(np.mean((said.force - measured.force) ** 2)), rel=1e-4
    )
    assert scores[chosen]["seconds"] == 3.0
    assert json.loads(json.dumps(evidence)) == evidence
    assert [entry["force_rmse_n"] for entry in read_log(workspace.folder / LOG)] == [
        score["force_rmse_n"] for score in scores.values()
    ]
    assert [done for done, _ in notes] == sorted(done for done, _ in notes)
    assert notes[-1][0] == pytest.approx(1.0)
    assert notes[-1][1].startswith("paper: ")


def test_the_kind_of_configuration_says_which_model(tmp_path, monkeypatch):
    monkeypatch.setattr("softfin.surrogate.choice.fit_streaming", lambda *words: small.surrogate())
    for config, kind in ((PAPER, Surrogate), (small.CONFIG, StreamingSurrogate)):
        fitted, evidence = fit_any(logs(False), config, 0, Workspace(tmp_path / "s", {}))
        assert type(fitted) is kind
        assert evidence is None


def test_logs_on_which_nothing_can_be_compared_are_refused_before_anything_is_fitted(tmp_path, monkeypatch):
    def no_fit(*words):
        raise AssertionError

    monkeypatch.setattr("softfin.surrogate.choice.fit_streaming", no_fit)
    short = [small.rows_of(log, 0, 300) for log in logs(False)]
    with pytest.raises(LogError, match="held-out log 0: 300 rows; more than a window of 300 are needed"):
        fit_any(short, CONFIG, 0, Workspace(tmp_path / "s", {}))


def test_candidates_differ_in_their_symmetry_alone():
    candidates = AutoConfig(streaming=StreamingConfig(members=3)).candidates()
    free = candidates["streaming, no symmetry"]
    assert not any((free.drive.mirror, free.force.mirror, free.force.turning))
    symmetric = {"drive": {"mirror": True}, "force": {"mirror": True, "turning": True}}
    assert free.merged(symmetric, "test") == candidates["streaming"]
