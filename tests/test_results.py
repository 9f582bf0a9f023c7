"""README and docs state what ``results/*.json`` hold; steps are run where they have to be, and their figures kept."""

import json
import sys

import pytest
from results import __main__ as program
from results import documents, record
from results.parts import BENCHMARKS, PARTS, Part, parts
from results.steps import Runner, step

from tests.documents import ROOT
from tests.test_documentation import understood

STEPS = {each.name: each for part in parts((0,)).values() for each in part.steps}
FILES = sorted((ROOT / "results").glob("*.json"))


def test_documents_state_what_the_results_hold():
    differing = [path.relative_to(ROOT).as_posix() for path in documents.differing()]
    assert not differing, f"{differing}: edit results/blocks/NAME.md, not the documents, and run `make figures`"
    assert sum(len(documents.names(path.read_text())) for path in documents.documents()) >= 15


@pytest.mark.parametrize("part", ["controllers-published", "bench-tank", "data-efficiency"])
def test_a_figure_that_changes_makes_a_document_differ(part):
    def changed(name):
        loaded = record.load(name)
        if name == part:
            loaded["figures"] = {key: each | {"text": "12345"} for key, each in loaded["figures"].items()}
        return loaded

    assert documents.differing(changed)


def test_a_figure_that_is_not_there_is_named():
    with pytest.raises(KeyError, match=r"tank\.json has no figure nothing"):
        documents.block("{tank.nothing}")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_result_is_of_a_part_and_says_where_it_comes_from(file):
    loaded = json.loads(file.read_text())
    assert file.stem in PARTS
    assert loaded["figures"]
    if "carried_over" in loaded:
        assert all("seeds" in each and "text" in each for each in loaded["figures"].values())
    else:
        assert loaded["scale"] == "full"
        assert all(len(each["seeds"]) == len(each["values"]) for each in loaded["figures"].values())
        assert {"commit", "date", "machine", "configuration", "steps"} <= set(loaded)
    for name, digest in loaded.get("pictures", {}).items():
        assert program.picture_digest(ROOT / name) == digest, f"{name} is not the picture of {file.name}"


def test_figures_are_stated_with_their_spread():
    # t(4, 0.975) = 2.776, and the standard deviation of 1 .. 5 is 1.581.
    assert record.shown(record.figure("N", [1, 2, 3, 4, 5])) == "3.000 ± 1.963"
    assert record.shown(record.figure("N", [[1, 3], [1, 3], [1, 3]]), ".1f") == "1.0 / 3.0"
    assert record.shown(record.figure("N", [[1, 3], [2, 4]]), ".0f") == "1 and 2 / 3 and 4"
    assert record.shown(record.figure("N", [1, 2]), ".1f", "plain") == "1.5"
    assert record.shown(record.figure("s", [3.0, 90.0, 4.0], summary="median"), ".0f") == "4 (3 to 90) s"
    assert record.shown(record.figure("N", [[1, 4], [2, 3]], summary="worst"), ".0f") == "2 / 4"
    assert record.shown(record.figure("s", [2.0, None], summary="median")) == "not in 1 of 2"
    assert record.shown({"text": "0.32 ± 0.08"}, summary="plain") == "0.32"


@pytest.mark.parametrize("name", STEPS)
def test_a_step_is_a_command_that_there_is_and_takes_an_hour_at_most(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    each = STEPS[name]
    assert 0 < each.minutes <= 60
    if each.words[0] == "softfin":
        assert each.words[-2:] == ("--out", name)
        understood(each.words[1:], monkeypatch)
        understood((*each.words[1:], *each.tiny), monkeypatch)
    elif each.words[1] == "-m":
        assert each.words[2] == "results.scripts" or each.words[3] in BENCHMARKS
    else:
        assert (ROOT / each.words[1]).is_file()


def test_every_benchmark_is_a_part():
    files = {file.stem for file in (ROOT / "benchmarks").glob("*.py")}
    assert files - set(BENCHMARKS) == {"__init__", "__main__", "compilation", "measure", "nets", "workers"}


COLLECT = "softfin collect --plant tests.plants:AnalyticFin --logs 1 --test-logs 0 --rows 40"


def rows(work):
    return {
        "rows": record.figure("", [work.json(f"short-{seed}/dataset.json")["configuration"]["rows"] for seed in (0, 1)])
    }


def small(seeds):
    steps = [step(f"short-{seed}", f"{COLLECT} --seed {seed}", 1, seed, "--rows 30") for seed in seeds]
    return Part("Two short logs", tuple(steps), rows)


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Call the program with one part, below a folder of its own."""
    monkeypatch.setattr(program, "PARTS", {"short": small})
    monkeypatch.setattr(program, "parts", lambda seeds: {"short": small(seeds)})

    def call(*words):
        monkeypatch.setattr(sys, "argv", ["results", "--tiny", str(tmp_path), *words])
        return program.main()

    return call


@pytest.mark.slow
def test_a_part_is_run_seed_by_seed_and_its_figures_are_kept(run, tmp_path, capsys):
    assert run("short", "--minutes", "0") == 0
    assert "goes on here next time" in capsys.readouterr().out
    assert run("short/1") == 0
    assert not (tmp_path / "results/short.json").exists()
    assert run() == 0
    kept = record.load("short", tmp_path / "results")
    assert kept["figures"]["rows"] == {"unit": "", "summary": "mean", "seeds": [0, 1], "values": [30, 30]}
    assert kept["scale"] == "tiny"
    assert set(kept["steps"]) == {"short-0", "short-1"}
    done = kept["steps"]["short-0"]
    assert done["command"].startswith("softfin collect")
    assert done["processor_s"] > 0
    assert done["peak_gib"] > 0
    capsys.readouterr()
    # It stands, so nothing is run.
    assert run() == 0
    assert capsys.readouterr().out == ""
    assert run("--list") == 0
    assert "stands" in capsys.readouterr().out


def test_a_step_has_to_be_run_again_where_its_words_or_what_it_needs_change(tmp_path):
    def digest(first, second):
        steps = (step("first", first, 1), step("second", second, 1))
        return Runner(tmp_path, steps).digest(steps[1])

    fit = "softfin fit first"
    before = digest("softfin collect --logs 2", fit)
    assert digest("softfin collect --logs 2", fit) == before
    assert digest("softfin collect --logs 3", fit) != before
    assert digest("softfin collect --logs 2", f"{fit} --seed 1") != before


def test_a_step_that_fails_is_told_and_one_that_cannot_be_run_keeps_its_reason(run, tmp_path, monkeypatch, capsys):
    failing = Part("Fails", (step("short-0", "softfin collect --plant nothing", 1),), rows)
    monkeypatch.setattr(program, "parts", lambda seeds: {"short": failing})
    assert run("short") == 1
    assert "failed with exit code 2" in capsys.readouterr().out
    without = Part("Cannot", (step("short-0", COLLECT, 1, extra="no_such_module"),), rows)
    monkeypatch.setattr(program, "parts", lambda seeds: {"short": without})
    record.write("short", {"title": "", "carried_over": "abc", "figures": {}}, tmp_path / "results")
    assert run("short") == 0
    assert record.load("short", tmp_path / "results")["skipped"] == "no_such_module is not installed"
