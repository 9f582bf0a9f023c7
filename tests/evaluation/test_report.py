import re
from collections import Counter
from html.parser import HTMLParser

import jax
import numpy as np
import pytest

from softfin.core.power import mean_powers
from softfin.core.window import interval
from softfin.evaluation.evaluate import EvaluateConfig, score_controller
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.figures import experiments_figure, fin_figure
from softfin.evaluation.headline import headline, over_seeds
from softfin.evaluation.paper import PAPER_TABLE_II
from softfin.evaluation.report import prediction_figure, write_report
from softfin.learning.controllers import learning_figure
from softfin.storage.figures import save_figure
from tests.plants import AnalyticFin, Flapper


class Page(HTMLParser):
    """Text, ids, headings and everything that a browser would fetch."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html = html
        self.text = ""
        self.ids = []
        self.fetched = []
        self.tags = []
        self.feed(html)
        self.words = " ".join(self.text.split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "xlink:href", "data") and not (value or "").startswith("#"):
                self.fetched.append(value)

    def handle_data(self, data):
        self.text += data + " "


def net(title, unit="N", published=None, parameters=129794, rmse=0.0312):
    scores = {"rmse": rmse, "mae": 0.002, "dtw_raw": 9.0, "dtw_rms": 0.4, "dtw_mae": 0.0015}
    return {
        "title": title,
        "unit": unit,
        "published": published,
        "window": 100,
        "parameters": parameters,
        "physical": scores,
        "scaled": {**scores, "rmse": rmse / 2},
    }


@pytest.fixture(scope="module")
def evaluation():
    return score_controller(Flapper(), AnalyticFin(noise_n=0.3), EvaluateConfig(seconds=4, seeds=3))


@pytest.fixture(scope="module")
def results(evaluation):
    still = score_controller(
        Flapper(angle=0.0), AnalyticFin(noise_n=0.3), EvaluateConfig(seconds=4, seeds=3)
    )
    return {
        "title": "A run",
        "plant": "the analytic fin",
        "surrogate": {
            "scores": {
                "posnet": net("PosNet, commands to angle", "rad", "posnet", 113601),
                "forcenet_measured": net("ForceNet, given the measured angle"),
                "forcenet_free_running": net("ForceNet, free-running behind PosNet", rmse=0.777),
            }
        },
        "controllers": {"single": evaluation.summary(), "grid": still.summary()},
        "configuration": {"collect": {"logs": 7}},
        "provenance": {
            "seed": 3,
            "softfin": "0.1.0",
            "created": "2026-01-01",
            "git_commit": None,
            "data_hash": "abc123",
        },
    }


@pytest.fixture(scope="module")
def page(results, evaluation, tmp_path_factory) -> Page:
    folder = tmp_path_factory.mktemp("report")
    path = folder / "report.html"
    force = np.random.default_rng(0).normal(size=(100, 2))
    recording = evaluation.recording
    one = jax.tree.map(lambda x: x[:1], (recording.reference, recording.command, recording.reading))
    trajectory = experiments_figure(ExperimentRecording(*one))
    save_figure(prediction_figure(force, {"free-running": force}), folder / "prediction.png")
    curves = learning_figure(([0, 1], [0, 1]))
    save_figure(curves, folder / "learning.png")
    save_figure(trajectory, folder / "single.png")
    single = folder / "single.png"
    save_figure(fin_figure(evaluation.recording), folder / "fin.png")
    figures = {
        "fin": {"The fin": folder / "fin.png"},
        "surrogate": {"Prediction": folder / "prediction.png"},
        "learning": {"Learning": folder / "learning.png"},
        "experiment": {"Single": single, "Single again": single},
    }
    write_report(path, results, figures)
    return Page(path.read_text())


def test_the_page_fetches_nothing(page):
    assert all(place.startswith("data:image/png;base64,") for place in page.fetched)
    assert not {"script", "link", "iframe", "object"} & set(page.tags)
    assert not re.search(r"@import|url\((?!#)", page.html)


def test_ids_are_unique_over_the_whole_page(page):
    assert [name for name, count in Counter(page.ids).items() if count > 1] == []
    links = re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', page.html)
    assert {a or b for a, b in links} <= set(page.ids)


def test_every_figure_is_there(page):
    assert page.tags.count("img") == len(page.fetched) == 5
    for caption in ("The fin", "Prediction", "Learning", "Single", "Single again"):
        assert caption in page.words


def test_the_fin_is_beside_the_headline(page):
    headline = page.html[page.html.index('id="headline"') :]
    assert "The fin" in headline[: headline.index("</section>")]


def test_table_one_has_each_net_in_both_units(page):
    assert (
        "PosNet, commands to angle 100 113,601 rad 0.0312 0.00200 0.00150 0.0156 0.00200 0.00150 "
        "ForceNet" in page.words
    )
    assert "ForceNet, free-running behind PosNet 100 129,794 N 0.777" in page.words


def test_table_two_has_errors_deviations_and_travel_and_tells_a_still_fin(page, evaluation):
    row = evaluation.summary()["references"][0]
    (x, y) = (row["x"], row["y"])
    spread = r" ±[\d.]+"
    cells = [
        f"{score:.3f}{spread}" for score in (x["error_n"], x["std_n"], y["error_n"], y["std_n"])
    ]
    cells += [re.escape(f"{value:#.3g}") for value in (x["raw_std_n"], y["raw_std_n"])]
    assert re.search(rf"\(1, .1\) {' '.join(cells)} ", page.words)
    assert page.words.count("does not move") == 6 + 1


class Tables(HTMLParser):
    """Width of each row of each table, in columns; a cell may span several rows and columns."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.widths = []
        self.feed(html)

    def handle_starttag(self, tag, attrs):
        if tag == "table":
            self.widths.append([])
            self.spanned = Counter()
        elif tag == "tr":
            self.widths[-1].append(self.spanned[len(self.widths[-1])])
        elif tag in ("td", "th"):
            spans = dict(attrs)
            columns = int(spans.get("colspan", 1))
            self.widths[-1][-1] += columns
            row = len(self.widths[-1])
            for below in range(row, row + int(spans.get("rowspan", 1)) - 1):
                self.spanned[below] += columns


@pytest.mark.parametrize("means_w", [None, [2.0, np.nan], [2.0, 4.0]])
def test_every_row_of_a_table_is_as_wide_as_its_header(results, evaluation, tmp_path, means_w):
    """With and without power, also if one of the references has none."""
    summary = evaluation.summary()
    references = [dict(row) for row in summary["references"]]
    mean = dict(summary["mean"])
    if means_w is not None:
        for row in (*references[1:], mean):
            row["power"] = mean_powers(3.0, means_w)
    controllers = {"single": {**summary, "references": references, "mean": mean}}
    write_report(tmp_path / "report.html", {**results, "controllers": controllers})
    html = (tmp_path / "report.html").read_text()
    tables = Tables(html).widths
    assert all(len(set(widths)) == 1 for widths in tables), tables
    (table_two,) = [widths for widths in tables if len(widths) == 2 + len(references)]
    assert table_two[0] == (8 if means_w is None else 10)
    assert ("J per minute" in html) == (means_w is not None)


def test_simulated_errors_do_not_stand_beside_those_of_the_papers_fin(page):
    # The style sheet has a colour of this name.
    assert "paper" not in page.words.replace("--paper", "")
    assert f"{PAPER_TABLE_II['single'][1, -1][0]:.3g}" not in page.words.split()


def test_configuration_and_provenance_are_told(page):
    assert "collect: logs: 7" in page.words
    assert "data_hash abc123" in page.words
    assert "seed 3 softfin 0.1.0" in page.words


def test_parts_without_data_are_absent(tmp_path):
    write_report(tmp_path / "empty.html", {})
    page = Page((tmp_path / "empty.html").read_text())
    for absent in ("Table I", "Learning", "Configuration", "Provenance", "None", "std"):
        assert absent not in page.words
    assert "svg" not in page.tags


def test_an_imported_surrogate_has_no_table_one(results, tmp_path):
    write_report(tmp_path / "report.html", {**results, "surrogate": {"scores": None}})
    words = Page((tmp_path / "report.html").read_text()).words
    assert "Table I." not in words
    assert "RMSE" not in words
    assert "Table II, grid" in words


def test_one_seed_has_no_interval(tmp_path):
    own = score_controller(
        Flapper(), AnalyticFin(), EvaluateConfig(references=[(0.5, 0)], seconds=3, seeds=1)
    )
    write_report(tmp_path / "report.html", {"controllers": {"single": own.summary()}})
    words = Page((tmp_path / "report.html").read_text()).words
    assert "(0.5, 0)" in words
    assert "±" not in words.partition("Definitions")[0]


def with_errors(summary, errors):
    """The summary of an evaluation, its references changed to these errors in y, alike at all
    seeds."""
    rows = [
        row | {"still": False, "x": row["x"] | {"error_n": 0.0}, "y": row["y"] | {"error_n": error}}
        for row, error in zip(summary["references"], errors, strict=True)
    ]
    mean = {axis: {"error_n": np.mean([row[axis]["error_n"] for row in rows])} for axis in "xy"}
    return summary | {"references": rows, "mean": mean}


def test_the_headline_is_of_the_best_controller_and_bounds_its_error_at_every_reference(evaluation):
    summary = evaluation.summary()
    good = with_errors(summary, [0.01, 0.02, 0.031, 0.0, 0.02, 0.02])
    best = headline({"controllers": {"bad": with_errors(summary, [0.1] * 6), "good": good}})
    assert best.controller == "good"
    assert best.holds
    assert best.sentence == "The fin holds each of 6 forces within 0.04 N on average."
    corrected = headline(
        {"controllers": {"good": good}, "with_feedback": {"good": with_errors(summary, [0.01] * 6)}}
    )
    assert "within 0.01 N on average" in corrected.sentence


def test_the_headline_says_which_forces_are_missed_and_that_a_fin_stands_still(evaluation):
    missing = with_errors(evaluation.summary(), [0.01, 0.3, 0.1, 0.0, 0.02, 0.25])
    said = headline({"controllers": {"single": missing}})
    assert not said.holds
    assert (
        "holds 4 of 6 forces within 0.2 N on average; it misses (2, \N{MINUS SIGN}1) N by "
        "0.30 N" in said.sentence
    )
    missing["references"][3]["still"] = True
    assert "does not move" in headline({"controllers": {"single": missing}}).sentence
    assert headline({}) is None


def test_the_errors_of_a_small_fin_have_more_decimals(tmp_path):
    config = EvaluateConfig(references=((0.2, 0), (0.1, 0.1)), seconds=4, seeds=3)
    evaluation = score_controller(Flapper(), AnalyticFin(noise_n=0.3), config)
    write_report(tmp_path / "report.html", {"controllers": {"single": evaluation.summary()}})
    page = Page((tmp_path / "report.html").read_text())
    error = evaluation.scores.error[0, :, 0].mean()
    assert re.search(rf"\(0\.2, 0\) {error:.4f} ±\d\.\d{{3}} ", page.words)


def test_the_page_begins_with_the_headline(page):
    assert page.tags.index("strong") < page.tags.index("nav") < page.tags.index("table")
    assert (
        "does not move at some of the target forces" in page.words
        or "of 6 forces within" in page.words
    )
    assert "window" in page.words.partition("Definitions")[0]


@pytest.mark.parametrize(("seeds", "shown"), [(1, ""), (2, " (0.100 to 0.300)"), (3, " ±0.25")])
def test_behind_an_error_stand_two_seeds_values_or_an_interval(seeds, shown):
    values = np.array([0.1, 0.3, 0.2][:seeds])
    assert over_seeds(interval(values), values.tolist()) == shown.strip()


def test_text_is_escaped(results, tmp_path):
    write_report(
        tmp_path / "report.html",
        {**results, "plant": "<script>alert(1)</script>", "title": "a & b"},
    )
    html = (tmp_path / "report.html").read_text()
    assert "<script>" not in html
    assert "<title>a &amp; b</title>" in html
