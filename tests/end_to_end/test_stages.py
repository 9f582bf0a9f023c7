"""The main job by `softfin reproduce`, small: collect, fit, map, train, evaluate, report."""

import json
import signal
from itertools import product

import pytest
import yaml

from softfin.cli import main
from softfin.learning.train import train_policies
from softfin.stages import reproduce
from softfin.stages.reproduce import Preset
from tests.staged import FIT, ROWS

PLANT = "tests.plants:PlainFin"
LEARNER = {"num_envs": 4, "num_steps": 6, "num_epochs": 2, "num_minibatches": 2}
TRAIN = {"steps": 48, "num_evaluations": 2, "policy": {"units": 8, "width": 8}, "ppo": LEARNER}
COLLECT = {"logs": 3, "test_logs": 1, "rows": ROWS}


def run(capsys, *words):
    capsys.readouterr()
    main([*words, "--json"])
    return json.loads(capsys.readouterr().out)


def write(path, values):
    path.write_text(yaml.safe_dump(values))
    return str(path)


SMALL = Preset(
    model="paper",
    collect=COLLECT,
    fit=FIT,
    gaits={"spacing_n": 1.7, "survey": {"pushes": 0}, "gaits": {"steps": 1}},
    policies={"single": {**TRAIN, "range": "reach"}, "grid": {**TRAIN, "range": "reach"}},
    evaluate={"seconds": 3, "moving": True},
    num_seeds=2,
)


def test_a_reproduction_that_was_stopped_goes_on_where_it_was_and_writes_results_and_a_report(
    capsys, tmp_path, monkeypatch
):
    """Stopped while the controllers train; the second call does not repeat what is complete."""
    out = tmp_path / "run"
    monkeypatch.setattr(reproduce, "PRESETS", {"paper": SMALL})
    monkeypatch.setattr(reproduce, "ONE_STEP", {"time_s": (0, 2), "force_n": ((2, -1), (2, 1))})
    words = ("reproduce", "--preset", "paper", "--plant", PLANT, "--out", str(out))
    trained = []

    def counted(plant, config, reachable, seed, run_directory, report):
        trained.append(f"{config.controller}-{seed}")
        return train_policies(plant, config, reachable, seed, run_directory, report)

    def stopped(*given):
        if len(trained) == 3:
            signal.raise_signal(signal.SIGINT)
        return counted(*given)

    monkeypatch.setattr("softfin.learning.train.train_policies", stopped)
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 1
    error = capsys.readouterr().err
    assert "stopped; no incomplete files were left; run it again with --resume to continue" in error
    assert (out / "surrogate").is_dir()
    assert not (out / "results.json").exists()

    monkeypatch.setattr("softfin.learning.train.train_policies", counted)
    results = run(capsys, *words, "--resume")
    assert trained == ["single-0", "single-1", "grid-0", "grid-1"]
    assert "collect" not in results["wall_s"]
    assert "fit" not in results["wall_s"]

    assert results == json.loads((out / "results.json").read_text())
    for kind, part in product(
        ("gaits", "single", "grid"), ("controllers", "with_feedback", "in_surrogate")
    ):
        rows = results[part][kind]["references"]
        assert len(rows) == 6
        for row, axis in product(rows, ("x", "y")):
            # Gaits are not trained from seeds: only a plant with noise has repetitions.
            assert kind == "gaits" or len(row[axis]["error_seeds_n"]) == 2
            assert row[axis]["error_interval_n"] is None
    assert [stage["stage"] for stage in results["stages"]][:7] == [
        "collect",
        "fit",
        "map",
        "train single-0",
        "train single-1",
        "train grid-0",
        "train grid-1",
    ]
    page = (out / "report.html").read_text()
    assert page.count("<img") > 6
    assert page.index("Fin with the best controller") < page.index("<nav")
    # Neither this fin nor the paper's networks can move in a page.
    assert not (out / "explore.html").exists()
    assert "explore.html" not in page
    assert 'src="http' not in page
    assert "@import" not in page
    assert results["surrogate"]["scores"]["forcenet_free_running"]["physical"]["rmse"] > 0

    with pytest.raises(SystemExit) as stop:
        main([*words, "--resume", "--seed", "7"])
    assert stop.value.code == 2
    assert "belongs to a different run (seed was 0 and is 7)" in capsys.readouterr().err

    written = (out / "results.json").stat().st_mtime_ns
    assert run(capsys, *words, "--resume") == results, "a complete run stays as it is"
    assert (out / "results.json").stat().st_mtime_ns == written
