import json

import numpy as np
import pytest

from softfin.surrogate.compare.compare import CompareConfig, compare_surrogates
from softfin.surrogate.compare.report import comparison_figure, write_comparison
from tests.surrogate.compare.test_compare import LOGS, candidate, compared


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


def test_the_folder_holds_scores_and_figures(tmp_path):
    summary = {**compared().summary, "dataset": "d"}
    (tmp_path / "c").mkdir()
    write_comparison(tmp_path / "c", compared(), summary)
    assert sorted(path.name for path in (tmp_path / "c").iterdir()) == [
        "comparison.json",
        "comparison.png",
        "comparison.svg",
    ]
    written = json.loads((tmp_path / "c" / "comparison.json").read_text())
    assert written == {"kind": "comparison", "format": 1, **summary}
    assert summary["dataset"] == "d"


def test_traces_show_what_was_measured_and_what_each_group_predicted():
    comparison = compared()
    axes = comparison_figure(comparison).get_axes()
    for index in range(2):
        shown = lines(axes[index])
        measured = shown["measured"].get_ydata()
        segment = next(
            i
            for i, force in enumerate(comparison.measured.reading.force)
            if np.array_equal(force[:, index], measured)
        )
        for group in comparison.groups:
            np.testing.assert_array_equal(
                shown[group.row["name"]].get_ydata(), group.reading.force[segment, :, index]
            )
    assert axes[1].get_xlabel() == "time since the start of the free run [s]"


def test_errors_stand_over_their_horizons_with_intervals_and_the_noise_floor():
    comparison = compared()
    summary = comparison.summary
    axes = comparison_figure(comparison).get_axes()[2]
    bars = {container.get_label(): container for container in axes.containers}
    assert set(bars) == {"paper, x", "paper, y", "attentive, x", "attentive, y"}
    cells = [row["force_y_rmse_n"]["mean"] for row in summary["groups"][0]["horizons"]]
    np.testing.assert_allclose(bars["paper, y"].lines[0].get_ydata(orig=False), cells)
    assert bars["paper, y"].has_yerr
    assert not bars["attentive, y"].has_yerr
    floor = summary["noise_floor"]["horizons"][0]
    mean = (floor["force_x_rmse_n"]["mean"] + floor["force_y_rmse_n"]["mean"]) / 2
    assert lines(axes)["second recording (fin), mean of x and y"].get_ydata()[0] == pytest.approx(
        mean
    )
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1", "2.5"]


def test_the_distribution_of_the_mean_forces_error_reaches_its_worst():
    comparison = compared()
    axes = comparison_figure(comparison).get_axes()[3]
    line = lines(axes)["paper"]
    worst = max(run.scores["mean_force_worst_n"] for run in comparison.groups[0].longest)
    assert line.get_xdata()[-1] == pytest.approx(worst)
    assert line.get_ydata()[-1] == 1
    assert "second recording (fin)" in lines(axes)


def test_intervals_are_drawn_where_they_are_stated():
    comparison = compared()
    axes = comparison_figure(comparison).get_axes()
    assert len(axes) == 5
    share = comparison.groups[1].longest[0].scores["coverage"]
    assert f"attentive: {share:.1%} inside" in lines(axes[4])
    assert not any(label.startswith("paper") for label in lines(axes[4]))


def test_panels_without_data_are_left_out():
    short = compare_surrogates([candidate(0)], LOGS, CompareConfig(horizons_s=(1,)))
    assert len(comparison_figure(short).get_axes()) == 3


def test_groups_that_are_not_shown_are_counted():
    many = compare_surrogates(
        [candidate(seed, group=str(seed)) for seed in range(5)],
        LOGS,
        CompareConfig(horizons_s=(1,)),
    )
    above = comparison_figure(many).get_axes()[0]
    assert len(above.get_lines()) == 4
    assert above.get_title(loc="left").endswith("2 more not shown")
