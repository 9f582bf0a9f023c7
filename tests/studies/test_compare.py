import json
import sys

import jax
import numpy as np
import pytest
from benchmarks.flops import flops_per_tick
from studies.compare import compare, comparison_figure, main
from studies.free_runs import run_from_rest

from softfin.core.errors import ArtifactError
from softfin.core.quantities import Log
from softfin.storage.dataset import write_dataset
from softfin.surrogate import save_surrogate
from tests.plants import AnalyticFin
from tests.surrogate import small
from tests.surrogate.streaming import small as streaming

HORIZONS_S = (1, 2.5)
LOGS = [streaming.recorded(560, seed) for seed in (1, 2)]


@pytest.fixture(scope="module")
def compared():
    surrogates = {"streaming": streaming.surrogate(), "paper": small.surrogate()}
    return compare(surrogates, LOGS, HORIZONS_S, AnalyticFin())


def test_all_surrogates_are_scored_on_the_same_rows(compared):
    memory = streaming.surrogate().memory
    assert memory > small.surrogate().memory
    np.testing.assert_array_equal(
        compared.measured.force[0], LOGS[0].reading.force[memory : memory + 250]
    )
    for candidate in compared.candidates:
        assert candidate.reading.force.shape == compared.measured.force.shape


def test_only_surrogates_that_state_intervals_have_a_coverage(compared):
    ensemble, paper = compared.candidates
    assert 0 <= ensemble.horizons[1]["coverage"] <= 1
    assert "coverage" not in ensemble.horizons[0]
    assert "coverage" not in paper.horizons[1]


def test_a_second_recording_of_a_fin_without_noise_has_no_error():
    fin = AnalyticFin(noise_n=0.0)
    recorded = run_from_rest(fin, LOGS, jax.random.key(0))
    logs = [Log(log.command, own) for log, own in zip(LOGS, recorded, strict=True)]
    comparison = compare({"paper": small.surrogate()}, logs, HORIZONS_S, fin)
    for scores in comparison.noise_floor.horizons:
        assert scores["force_x_rmse_n"] == scores["angle_rmse_rad"] == 0


def test_the_figure_shows_traces_errors_and_intervals(compared):
    axes = comparison_figure(compared).get_axes()
    assert len(axes) == 5
    labels = [axis.get_legend_handles_labels()[1] for axis in axes]
    assert labels[0] == ["measured", "streaming", "paper"]
    assert "second recording" in labels[2]
    assert labels[3] == ["streaming", "paper", "second recording"]
    inside = compared.candidates[0].horizons[1]["coverage"]
    assert labels[4] == [f"streaming: {inside:.1%} inside", "85% to 95%"]


def test_the_command_writes_what_the_results_read(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_surrogate(tmp_path / "s", streaming.surrogate(), None, {})
    write_dataset(tmp_path / "d", LOGS[:1], LOGS[1:], {})
    words = "compare s --dataset d --horizons 2.5 1 --noise-floor tests.plants:AnalyticFin --out c"
    monkeypatch.setattr(sys, "argv", words.split())
    main()
    written = json.loads((tmp_path / "c" / "comparison.json").read_text())
    (row,) = written["surrogates"]
    assert (row["model"], written["horizons_s"]) == ("streaming", [1, 2.5])
    assert row["flops_per_tick"] == flops_per_tick(streaming.surrogate())
    assert {"angle_rmse_rad", "mean_force_p95_n", "coverage_x"} <= row["horizons"][1].keys()
    assert written["noise_floor"]["horizons"][0]["force_x_rmse_n"] > 0
    assert (tmp_path / "c" / "comparison.png").is_file()
    assert "s, 1 s: angle_rmse_rad" in capsys.readouterr().out


def test_a_dataset_without_test_logs_is_refused(tmp_path, monkeypatch):
    save_surrogate(tmp_path / "s", small.surrogate(), None, {})
    write_dataset(tmp_path / "d", LOGS, [], {})
    words = ["compare", str(tmp_path / "s"), "--dataset", str(tmp_path / "d"), "--out", "c"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(ArtifactError, match="contains no test logs"):
        main()
