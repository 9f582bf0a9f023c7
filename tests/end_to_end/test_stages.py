"""The main job by `softfin reproduce`, small: collect, fit, map, train, evaluate, report."""

import json
import signal
from itertools import product

import pytest
import yaml

from softfin.cli import main
from softfin.core.errors import LogError
from softfin.learning.train import train_policies
from softfin.stages.reproduce_config import PRESETS
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


def reproduction(tmp_path):
    config = {
        "collect": COLLECT,
        "fit": FIT,
        "single": {**TRAIN, "range": "reach"},
        "grid": {**TRAIN, "range": "reach"},
        "gaits": {"spacing_n": 1.7, "survey": {"pushes": 0}, "gaits": {"steps": 1}},
        "evaluate": {"seconds": 3, "moving": ["step"], "trim": {}},
        "seeds": 2,
    }
    return write(tmp_path / "run.yaml", config)


def test_a_reproduction_that_was_stopped_goes_on_where_it_was_and_writes_results_and_a_report(
    capsys, tmp_path, monkeypatch
):
    """Stopped while the controllers train; the second call does not repeat what is complete."""
    out = tmp_path / "run"
    words = (
        "reproduce",
        "--preset",
        "paper",
        "--plant",
        PLANT,
        "--config",
        reproduction(tmp_path),
        "--out",
        str(out),
    )
    trained = []

    def counted(plant, config, reachable, seed, run_directory, report):
        trained.append(f"{config.controller}-{seed}")
        return train_policies(plant, config, reachable, seed, run_directory, report)

    def stopped(*given):
        if len(trained) == 3:
            signal.raise_signal(signal.SIGINT)
        return counted(*given)

    monkeypatch.setattr("softfin.stages.controllers.train_policies", stopped)
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 1
    error = capsys.readouterr().err
    assert "stopped; no incomplete files were left; run it again with --resume to continue" in error
    assert (out / "surrogate").is_dir()
    assert not (out / "results.json").exists()

    monkeypatch.setattr("softfin.stages.controllers.train_policies", counted)
    results = run(capsys, *words, "--resume")
    assert trained == ["single-0", "single-1", "grid-0", "grid-1"]
    assert "collect" not in results["wall_s"]
    assert "fit" not in results["wall_s"]

    assert results == json.loads((out / "results.json").read_text())
    for kind, part in product(
        ("gaits", "single", "grid"), ("controllers", "trimmed", "in_surrogate")
    ):
        rows = results[part][kind]["references"]
        assert len(rows) == 6
        for row, axis in product(rows, ("x", "y")):
            assert len(row[axis]["error_seeds_n"]) == 2
            assert row[axis]["error_interval_n"] is None
    assert all(len(results["trimmed"][kind]["moving"]) == 4 for kind in ("gaits", "single", "grid"))
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
    assert "<svg" in page
    # Neither this fin nor the paper's networks can move in a page.
    assert not (out / "explore.html").exists()
    assert "explore.html" not in page
    assert "src=" not in page
    assert "@import" not in page
    assert results["surrogate"]["scores"]["forcenet_free_running"]["physical"]["rmse"] > 0

    with pytest.raises(SystemExit) as stop:
        main([*words, "--resume", "--seed", "7"])
    assert stop.value.code == 2
    assert "belongs to another run (seed was 0 and is 7)" in capsys.readouterr().err

    written = (out / "results.json").stat().st_mtime_ns
    assert run(capsys, *words, "--resume") == results, "a complete run stays as it is"
    assert (out / "results.json").stat().st_mtime_ns == written


def test_reproduce_takes_the_logs_that_it_recorded_as_they_are_and_fits_what_its_preset_says(
    tmp_path, monkeypatch
):
    asked = {}

    def fit(dataset, out, config, **options):
        asked.update(options, config=config)
        raise LogError("enough")

    monkeypatch.setattr("softfin.stages.reproduce.fit", fit)
    small = write(tmp_path / "small.yaml", {"collect": COLLECT})
    with pytest.raises(SystemExit):
        main(
            [
                "reproduce",
                "--preset",
                "demo",
                "--plant",
                PLANT,
                "--config",
                small,
                "--out",
                str(tmp_path / "run"),
            ]
        )
    assert asked["ignore_errors"] is True
    assert asked["config"] == PRESETS["demo"].fit
