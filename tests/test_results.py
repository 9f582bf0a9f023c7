"""README and docs state what ``results/*.json`` hold; finished steps are reused, and one seed is
compared."""

import json
import math
import subprocess
import sys
import types

import numpy as np
import pytest
from results import __main__ as program
from results import comparison, documents, history, quick, record, steps
from results.parts import BENCHMARKS, PARTS, Part, parts
from results.parts.common import Work
from results.steps import Runner, step

from tests.documents import ROOT
from tests.test_documentation import reaches_work, understood

STEPS = {each.name: each for part in parts((0,)).values() for each in part.steps}
FILES = sorted((ROOT / "results").glob("*.json"))


def test_documents_state_what_the_results_hold():
    differing = [path.relative_to(ROOT).as_posix() for path in documents.differing()]
    assert not differing, (
        f"{differing}: edit results/blocks/NAME.md, not the documents, and run `make figures`"
    )
    assert sum(len(documents.names(path.read_text())) for path in documents.documents()) >= 15


@pytest.mark.parametrize("part", ["controllers-published", "bench-tank", "data-efficiency"])
def test_a_figure_that_changes_makes_a_document_differ(part):
    def changed(name):
        loaded = record.load(name)
        if name == part:
            loaded["figures"] = {
                key: each | {"values": [12345.0]} for key, each in loaded["figures"].items()
            }
        return loaded

    assert documents.differing(changed)


def test_a_figure_that_is_not_there_is_named():
    with pytest.raises(KeyError, match=r"tank\.json has no figure nothing"):
        documents.block("{tank.nothing}")


def test_a_figure_that_may_be_newer_than_its_file_is_said_to_be_missing():
    text = documents.block("{tank.nothing?:.1f} N, {demo.gaits.error?:.1f} N\n")
    assert text == f"not yet measured N, {documents.block('{demo.gaits.error:.1f}')} N\n"


FEEDBACK = [name for name in STEPS if "--feedback" in STEPS[name].words]


def test_feedback_of_gaits_has_a_family_and_that_of_policies_has_none():
    kinds = {name: "single" in name or "grid" in name for name in FEEDBACK}
    assert {bool(STEPS[name].after) != is_policy for name, is_policy in kinds.items()} == {True}
    assert set(kinds.values()) == {True, False}


@pytest.mark.parametrize("name", [name for name in FEEDBACK if STEPS[name].after])
def test_feedback_is_evaluated_after_the_search_for_the_family(name, tmp_path):
    each = STEPS[name]
    (family,) = each.after
    ordered = [other.name for other in Runner(tmp_path, tuple(STEPS.values())).ordered([each])]
    assert ordered.index(family) < ordered.index(name)
    plant = each.words[each.words.index("--plant") + 1]
    assert STEPS[family].words[2:] == (each.words[2], "--plant", plant)
    assert ordered.index(STEPS[family].words[2].partition("/")[0]) < ordered.index(family)


def test_the_line_below_a_table_names_files_seeds_and_dates():
    line = documents.block("| {demo.gaits.error} |\n").splitlines()[-1]
    assert line == f"*Sources: `demo.json` (5 seeds, {record.load('demo')['date']}).*"


def test_a_source_names_file_commits_date_seeds_machine_and_age(monkeypatch):
    monkeypatch.setattr(record, "describe_age", lambda commits: "14 commits old on 2026-11-24")
    loaded = record.load("demo") | {"commits": ["c3"]}
    for busy_cores, load in ((0.0, "quiet"), (1.44, "other programs used up to 1.4 cores")):
        for step_record in loaded["steps"].values():
            step_record["others_cores"] = busy_cores
        assert record.source("demo", loaded) == (
            f"`results/demo.json` (commit c3; {loaded['date']}; 5 seeds; "
            f"{loaded['machine']['processor']} with 2 cores, {load}; 14 commits old on 2026-11-24)"
        )


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_result_is_of_a_part_and_says_where_it_comes_from(file):
    loaded = json.loads(file.read_text())
    assert file.stem in PARTS
    assert {"title", "commits", "date", "scale", "machine", "figures", "steps"} <= set(loaded)
    # Figures measured before these were recorded do not have them.
    recorded_later = {"seeds", "versions"}
    assert set(loaded) & recorded_later in (set(), recorded_later)
    assert loaded["scale"] == "full"
    assert loaded["figures"]
    assert all(len(each["seeds"]) == len(each["values"]) for each in loaded["figures"].values())
    step_keys = {
        "command",
        "commit",
        "changed",
        "date",
        "wall_s",
        "processor_s",
        "peak_gib",
        "others_cores",
    }
    assert all(step_keys <= set(each) for each in loaded["steps"].values())
    assert loaded["commits"] == list(
        dict.fromkeys(each["commit"] for each in loaded["steps"].values())
    )
    if history.has_full_history():
        unknown = [commit for commit in loaded["commits"] if not history.has_commit(commit)]
        assert not unknown, (
            f"{file.name}: measured at commits that are not in the history: {unknown}"
        )
    assert all((ROOT / picture).is_file() for picture in PARTS[file.stem]((0,)).pictures)


def test_figures_are_stated_with_their_spread():
    # t(4, 0.975) = 2.776, and the standard deviation of 1 .. 5 is 1.581.
    assert record.shown(record.figure("N", [1, 2, 3, 4, 5])) == "3.000 ± 1.963"
    assert record.shown(record.figure("N", [[1, 3], [1, 3], [1, 3]]), ".1f") == "1.0 / 3.0"
    assert record.shown(record.figure("N", [[1, 3], [2, 4]]), ".0f") == "1 and 2 / 3 and 4"
    assert record.shown(record.figure("N", [1, 2]), ".1f", "plain") == "1.5"
    assert (
        record.shown(record.figure("s", [3.0, 90.0, 4.0], summary="median"), ".0f")
        == "4 (3 to 90) s"
    )
    assert record.shown(record.figure("N", [[1, 4], [2, 3]], summary="worst"), ".0f") == "2 / 4"
    assert record.shown(record.figure("s", [2.0, None], summary="median")) == "not in 1 of 2"


@pytest.mark.parametrize("name", STEPS)
def test_a_step_is_a_command_that_there_is_and_takes_an_hour_at_most(name, monkeypatch):
    monkeypatch.chdir(ROOT)
    each = STEPS[name]
    assert 0 < each.minutes <= 60
    if each.words[0] == "softfin":
        # A family is written into the folder of its controller.
        assert each.words[-2:] == ("--out", name) or each.program == "family"
        understood(each.words[1:])
        understood((*each.words[1:], *each.tiny))
    elif each.program.startswith("studies."):
        script = ROOT / f"{each.program.replace('.', '/')}.py"
        for words in (each.words[3:], (*each.words[3:], *each.tiny)):
            assert reaches_work(script, words, monkeypatch)
    elif each.words[1] == "-m":
        assert each.words[2] == "results.scripts" or each.words[3] in BENCHMARKS
    else:
        assert (ROOT / each.words[1]).is_file()


def test_the_robots_figures_state_the_seeds_of_their_targets(tmp_path):
    part = PARTS["robot"]((3, 4))
    axes = dict.fromkeys(("surge", "yaw"), 0.1)
    columns = ("target", "error", "error_worst", "error_of_references", "ripple")
    found = dict.fromkeys(columns, axes) | {"references_unreachable": 0.2}
    evaluations = [each for each in part.steps if each.seed is not None]
    assert [each.seed for each in evaluations] == [3, 4, 3, 4]
    assert all(f"--seed {each.seed}" in each.command for each in evaluations)
    for each in evaluations:
        (tmp_path / each.name).mkdir()
        (tmp_path / each.name / "robot.json").write_text(json.dumps(found))
    figures = part.figures(Work(tmp_path))
    for name in ("error.surge", "dead.worst.yaw", "unreachable"):
        assert figures[name]["seeds"] == [3, 4]
    assert figures["worst.surge"]["summary"] == "worst"


def test_a_seed_that_a_part_does_not_have_is_refused_before_anything_runs(run, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("short/1", "short/3")
    assert not list((tmp_path / "work").glob("*.step.json"))
    assert "Two short logs: no step of seed 3; the seeds are 0, 1" in capsys.readouterr().err


def test_every_benchmark_is_a_part():
    files = {file.stem for file in (ROOT / "benchmarks").glob("*.py")}
    assert files - set(BENCHMARKS) == {
        "__init__",
        "__main__",
        "compilation",
        "flops",
        "measure",
        "nets",
        "recurrent",
    }


COLLECT = "softfin collect --plant tests.plants:AnalyticFin --logs 1 --test-logs 0 --rows 40"


def rows(work):
    return {
        "rows": record.figure(
            "",
            [work.json(f"short-{seed}/dataset.json")["configuration"]["rows"] for seed in (0, 1)],
        )
    }


def small(seeds):
    steps = [
        step(f"short-{seed}", f"{COLLECT} --seed {seed}", 1, seed, "--rows 30") for seed in seeds
    ]
    return Part("Two short logs", tuple(steps), rows)


@pytest.fixture
def git(monkeypatch):
    """A history of five commits whose last is HEAD; a test can move HEAD or change files."""
    state = types.SimpleNamespace(head="c4", has_changes=False)
    commits = ["c0", "c1", "c2", "c3", "c4", "c5"]

    def list_commits_since(commit):
        first = state.head if commit == "HEAD" else commit
        return set(commits[commits.index(first) : commits.index(state.head) + 1])

    monkeypatch.setattr(history, "read_head", lambda: state.head)
    monkeypatch.setattr(history, "has_changes", lambda: state.has_changes)
    monkeypatch.setattr(history, "list_commits_since", list_commits_since)
    return state


@pytest.fixture
def run(git, monkeypatch, tmp_path):
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
    assert "run again to continue" in capsys.readouterr().out
    assert run("short/1") == 0
    assert "short: not finished: short-0" in capsys.readouterr().out
    assert not (tmp_path / "results/short.json").exists()
    assert run() == 0
    kept = record.load("short", tmp_path / "results")
    assert kept["figures"]["rows"] == {
        "unit": "",
        "summary": "mean",
        "seeds": [0, 1],
        "values": [30, 30],
    }
    assert kept["scale"] == "tiny"
    assert kept["commits"] == ["c4"]
    assert kept["seeds"] == [0, 1]
    assert set(kept["versions"]) == {"python", *record.PACKAGES}
    assert set(kept["steps"]) == {"short-0", "short-1"}
    done = kept["steps"]["short-1"]
    assert done["command"].startswith("softfin collect")
    assert done["seed"] == 1
    assert done["changed"] is False
    assert done["machine"]["cores"] > 0
    assert done["processor_s"] > 0
    assert done["peak_gib"] > 0
    capsys.readouterr()
    # All steps are reused.
    assert run() == 0
    assert "softfin collect" not in capsys.readouterr().out


SCRIPT = """
import json, sys
from pathlib import Path
name, value = sys.argv[1:3]
if value == "fail":
    raise SystemExit(3)
Path(name).mkdir(exist_ok=True)
with (Path(name) / "arguments.txt").open("a") as file:
    file.write(" ".join(sys.argv[1:]) + "\\n")
(Path(name) / "value.json").write_text(value)
"""


@pytest.fixture
def script(tmp_path):
    file = tmp_path / "script.py"
    file.write_text(SCRIPT)
    return file


@pytest.fixture
def chain(script):
    """Steps of which the second needs the first."""
    return (
        step("first", f"python {script} first 1", 1),
        step("second", f"python {script} second 2 first", 1),
    )


def test_a_finished_step_is_reused_at_its_commit_alone(git, chain, tmp_path):
    first, second = chain
    runner = Runner(tmp_path, chain)
    assert runner.record(first) is None
    runner.run(first)
    runner.run(second)
    assert Runner(tmp_path, chain).record(second)["commit"] == "c4"
    changed = step("first", f"{first.command} other", 1)
    assert Runner(tmp_path, (changed, second)).record(changed) is None
    git.head = "c5"
    assert Runner(tmp_path, chain).record(second) is None
    assert Runner(tmp_path, chain, since="c5").record(second) is None
    assert Runner(tmp_path, chain, since="c4").record(second)["commit"] == "c4"
    assert Runner(tmp_path, chain, since="c1").record(second)["commit"] == "c4"


def test_a_step_of_uncommitted_code_counts_in_its_own_run_alone(git, chain, tmp_path):
    git.has_changes = True
    runner = Runner(tmp_path, chain)
    for each in chain:
        runner.run(each)
    assert runner.record(chain[1])["changed"] is True
    assert Runner(tmp_path, chain).record(chain[1]) is None
    git.has_changes = False
    assert Runner(tmp_path, chain).record(chain[1]) is None


def test_nothing_is_reused_for_code_that_has_changed(git, chain, tmp_path):
    runner = Runner(tmp_path, chain)
    for each in chain:
        runner.run(each)
    git.has_changes = True
    assert Runner(tmp_path, chain).record(chain[0]) is None


def test_a_step_runs_again_after_one_that_it_needs(git, chain, tmp_path):
    first, second = chain
    runner = Runner(tmp_path, chain)
    runner.run(first)
    runner.run(second)
    runner.run(first)
    assert runner.record(first) is not None
    assert runner.record(second) is None
    assert Runner(tmp_path, chain).record(second) is None


@pytest.mark.parametrize(
    ("head", "has_changes", "continues"),
    [("c4", False, True), ("c5", False, False), ("c4", True, False)],
)
def test_a_stopped_step_continues_at_the_same_commit_alone(
    git, script, head, has_changes, continues, tmp_path, monkeypatch
):
    monkeypatch.setattr(steps, "RESUMED", {str(script): ("--resume",)})
    each = step("first", f"python {script} first 1", 1)
    script.write_text(f"{SCRIPT}\nraise SystemExit(9)")
    with pytest.raises(subprocess.CalledProcessError):
        Runner(tmp_path, (each,)).run(each)
    script.write_text(SCRIPT)
    git.head = head
    git.has_changes = has_changes
    runner = Runner(tmp_path, (each,))
    runner.run(each)
    lines = (tmp_path / "first/arguments.txt").read_text().splitlines()
    assert lines == (["first 1", "first 1 --resume"] if continues else ["first 1"])
    assert runner.record(each)["resumed"] is continues


def test_again_runs_the_steps_of_a_part_again_once(git, chain, run, tmp_path, monkeypatch, capsys):
    table = {
        "one": Part(
            "One",
            chain[:1],
            lambda work: {"value": record.figure("N", [work.json("first/value.json")])},
        ),
        "two": Part(
            "Two",
            chain,
            lambda work: {"value": record.figure("N", [work.json("second/value.json")])},
        ),
    }
    monkeypatch.setattr(program, "PARTS", table)
    monkeypatch.setattr(program, "parts", lambda seeds: table)
    assert run() == 0
    capsys.readouterr()
    assert run("--again") == 0
    output = capsys.readouterr().out
    assert output.count(chain[0].command) == 1
    assert output.count(chain[1].command) == 1


def test_a_failed_step_is_reported_and_the_other_parts_run(
    run, script, tmp_path, monkeypatch, capsys
):
    def value(name):
        return lambda work: {"value": record.figure("N", [work.json(f"{name}/value.json")])}

    table = {
        "fails": Part("Fails", (step("a", f"python {script} a fail", 1),), value("a")),
        "lacks": Part(
            "Lacks", (step("b", f"python {script} b 1", 1, extra="no_such_module"),), value("b")
        ),
        "unreadable": Part("Unreadable", (step("c", f"python {script} c 1", 1),), value("d")),
        "works": Part("Works", (step("e", f"python {script} e 1", 1),), value("e")),
    }
    monkeypatch.setattr(program, "PARTS", table)
    monkeypatch.setattr(program, "parts", lambda seeds: table)
    assert run() == 1
    lines = [line[6:] for line in capsys.readouterr().out.splitlines()]
    assert f"fails: failed: a ended with exit code 3; see {tmp_path / 'work/a.log'}" in lines
    assert "lacks: not finished: no_such_module is not installed" in lines
    assert any(
        line.startswith("unreadable: failed: the files of its steps are not as expected")
        for line in lines
    )
    assert [file.name for file in (tmp_path / "results").iterdir()] == ["works.json"]


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A repository of three commits, in which history looks."""
    folder = tmp_path / "repository"
    folder.mkdir()
    monkeypatch.setattr(history, "ROOT", folder)
    for key in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{key}_NAME", "someone")
        monkeypatch.setenv(f"GIT_{key}_EMAIL", "someone@example.org")
    assert history.run_git("init", "--quiet", "--initial-branch", "main") is not None
    for index, name in enumerate(("src/softfin/tank/fin.py", "docs/index.md", "uv.lock")):
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(str(index))
        history.run_git("add", ".")
        assert history.run_git("commit", "--quiet", "--message", name) is not None
    return folder


def test_the_history_tells_age_and_changes(repository):
    newest, middle, oldest = history.run_git("log", "--format=%h", "--abbrev=7").split()
    assert history.read_head() == newest
    assert history.find_oldest([newest, oldest]) == (oldest, 2)
    assert history.describe_age([oldest]).startswith("2 commits old on 20")
    assert history.describe_age([middle]).startswith("1 commit old on 20")
    assert history.list_changes_since(oldest) == ["uv.lock"]
    assert history.list_changes_since(newest) == []
    assert history.list_commits_since(middle) == {middle, newest}
    assert history.list_commits_since("HEAD") == {newest}
    assert not history.has_changes()
    (repository / "src/softfin/tank/fin.py").write_text("changed")
    assert history.list_changes_since(newest) == ["tank"]
    assert history.has_changes()


def test_unknown_commits_have_no_age(repository, tmp_path, monkeypatch):
    oldest = history.run_git("log", "--format=%h", "--reverse").split()[0]
    shallow = tmp_path / "shallow"
    assert (
        history.run_git("clone", "--quiet", "--depth", "1", repository.as_uri(), str(shallow))
        is not None
    )
    assert history.has_full_history()
    monkeypatch.setattr(history, "ROOT", shallow)
    assert not history.has_full_history()
    assert not history.has_commit(oldest)
    assert history.find_oldest([history.read_head(), oldest]) is None
    assert history.describe_age([oldest]) == history.UNKNOWN_AGE
    with pytest.raises(ValueError, match="unknown in this clone"):
        history.list_commits_since(oldest)
    record.write(
        "demo", {"date": "2026-11-24", "commits": [oldest], "figures": {}, "steps": {}}, tmp_path
    )
    assert program.describe("demo", tmp_path).endswith(
        f"age unknown: this clone does not have {oldest}; run `git fetch --unshallow`"
    )


def test_a_commit_of_another_branch_is_no_beginning(repository):
    history.run_git("checkout", "--quiet", "-b", "side", "HEAD~1")
    history.run_git("commit", "--quiet", "--allow-empty", "--message", "side")
    side = history.read_head()
    history.run_git("checkout", "--quiet", "main")
    with pytest.raises(ValueError, match="not in the history of HEAD"):
        history.list_commits_since(side)


def test_the_list_has_each_part_with_age_and_changes(monkeypatch, capsys):
    monkeypatch.setattr(history, "find_oldest", lambda commits: (commits[-1], 14))
    monkeypatch.setattr(history, "list_changes_since", lambda commit: ["robot", "uv.lock"])
    monkeypatch.setattr(sys, "argv", ["results", "--list"])
    assert program.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(PARTS)
    commit = record.load("demo")["commits"][0]
    assert any(f"{commit}; 14 commits old; changed since: robot, uv.lock" in line for line in lines)


def test_a_part_without_figures_is_listed(tmp_path):
    assert program.describe("demo", tmp_path) == "no demo.json; run `python -m results demo`"


# t(4, 0.975) = 2.776; over 1 .. 5 with s = 1.581 the margin of a further value is 2.776 s sqrt(1 +
# 1/5) = 4.809.
FIVE = record.figure("N", [1, 2, 3, 4, 5])


@pytest.mark.parametrize(
    ("stated", "value", "verdict"),
    [
        (FIVE, 7.8, "inside"),
        (FIVE, 7.82, "outside"),
        (FIVE, -1.82, "outside"),
        (FIVE | {"summary": "worst"}, 9.8, "inside"),
        (FIVE | {"summary": "worst"}, 9.82, "outside"),
        (FIVE | {"summary": "worst"}, -50.0, "inside"),
        (FIVE, None, "outside"),
        (FIVE, math.nan, "outside"),
        (record.figure("N", [2.0]), 2.09, "inside"),
        (record.figure("N", [2.0]), 2.11, "outside"),
        (record.figure("N", [2.0, 3.0]), 3.12, "inside"),
        (record.figure("N", [2.0, 3.0]), 3.13, "outside"),
        (record.figure("N", [2.0] * 5), 1.91, "inside"),
        (record.figure("N", [2.0] * 5), 1.89, "outside"),
        (record.figure("N", [0.0] * 5), 0.0009, "inside"),
        (record.figure("N", [0.0] * 5), 0.0011, "outside"),
        (record.figure("s", [2.0, None]), None, "inside"),
        (record.figure("s", [2.0, None]), 2.2, "not judged"),
        (record.figure("s", [2.0, 2.0, 2.0, None]), 2.2, "outside"),
        (record.figure("s", [None]), None, "inside"),
        (record.figure("s", [None]), 1.0, "outside"),
        (record.figure("N", [[1, 10], [2, 10], [3, 10]]), [2, 10.4], "inside"),
        (record.figure("N", [[1, 10], [2, 10], [3, 10]]), [2, 10.6], "outside"),
        (record.figure("N", [[1, 10], [2, 10], [3, 10]]), [12, 10.4], "outside"),
        (record.figure("N", [[1, 10], [2, 10], [3, 10]]), 2.0, "outside"),
    ],
)
def test_one_seed_is_judged_by_the_interval_of_a_further_one(stated, value, verdict):
    measured = record.figure(stated["unit"], [value], summary=stated["summary"])
    assert comparison.compare(stated, measured, 0.001).verdict == verdict


def test_a_seed_that_gives_its_stated_value_again_is_inside():
    """Even if it is as far from the other four as it can be."""
    stated = record.figure("N", [1.0] * 4 + [1.9])
    assert comparison.compare(stated, record.figure("N", [1.9], [4]), 0.001).verdict == "inside"


@pytest.mark.parametrize(("seed", "verdict"), [(0, "outside"), (7, "not judged")])
def test_another_seed_of_a_figure_without_interval_is_not_judged(seed, verdict):
    stated = record.figure("N", [2.0, 3.0])
    assert comparison.compare(stated, record.figure("N", [9.0], [seed]), 0.001).verdict == verdict


def test_a_correct_program_passes_with_as_many_figures_outside_as_chance_puts_there():
    """Seeds that are drawn anew: of 400 figures, about one in twenty lies outside, and none far
    outside."""
    random = np.random.default_rng(0)
    stated = {
        str(name): record.figure("N", random.normal(3, 0.6, 5).tolist()) for name in range(200)
    }
    stated |= {
        str(name): record.figure("N", random.normal(3, 0.6, (5, 2)).tolist())
        for name in range(200, 400)
    }
    measured = {
        name: record.figure(
            "N", [random.normal(3, 0.6, np.shape(figure["values"][0])).tolist()], [99]
        )
        for name, figure in stated.items()
    }
    found = comparison.compare_figures(stated, measured, {}, 0.001)
    outside = sum(each.verdict == "outside" for each in found.values())
    assert 0 < outside <= comparison.allowed_outside(400) < 40
    assert not any(each.is_far for each in found.values())


@pytest.mark.parametrize(
    ("values", "value", "is_far"),
    [
        ([1.0, 1.1, 0.9], 3.5, True),
        ([1.0, 1.1, 0.9], 0.1, True),
        ([1.0, 1.1, 0.9], 3.2, False),
        ([0.1, 2.0, 0.5], 5.5, False),
        ([[1.0, 1.0], [1.1, 1.1], [0.9, 0.9]], [1.0, 3.5], True),
        ([[1.0, 1.0], [1.1, 1.1], [0.9, 0.9]], [1.0, 2.9], False),
        ([1.0, 1.1, 0.9], None, False),
    ],
)
def test_a_figure_is_far_outside_if_it_has_changed_by_more_than_a_factor_of_three(
    values, value, is_far
):
    stated = record.figure("N", values)
    found = comparison.compare(stated, record.figure("N", [value]), 0.001)
    assert found.is_far == is_far


def test_figures_of_the_machine_are_not_judged_and_missing_ones_are():
    stated = {"time": record.figure("s", [1.0]), "gone": FIVE, "empty": FIVE}
    measured = {
        "time": record.figure("s", [100.0], machine_dependent=True),
        "new": record.figure("N", [1.0]),
        "empty": record.figure("N", []),
    }
    found = comparison.compare_figures(stated, measured, {}, 0.001)
    verdicts = {name: each.verdict for name, each in found.items()}
    assert verdicts == {
        "time": "not judged",
        "gone": "missing",
        "empty": "missing",
        "new": "not judged",
    }


def test_printed_digits_are_those_of_the_blocks():
    digits = documents.printed_digits()
    assert digits["surrogates", "streaming.same.angle_rmse"] == pytest.approx(1e-4)
    assert digits["surrogates", "streaming.flops"] == 1.0


@pytest.fixture
def quick_run(git, script, monkeypatch, tmp_path):
    """Call a quick run of one or more parts, each of one step that prints a value."""
    monkeypatch.setattr(program, "FOLDER", tmp_path / "stated")
    monkeypatch.setattr(program, "QUICK_WORK", tmp_path / "quick")
    monkeypatch.setattr(sys, "argv", ["results", "--quick"])
    asked_seeds = []

    def part(name, value, extra=None):
        def read(work):
            return {"error": record.figure("N", [work.json(f"{name}/value.json")])}

        return Part(
            name, (step(name, f"python {script} {name} {value} common", 1, 0, extra=extra),), read
        )

    def call(values, **extras):
        common = step("common", f"python {script} common 0", 1)
        table = {name: part(name, value, extras.get(name)) for name, value in values.items()}
        table = {name: each._replace(steps=(common, *each.steps)) for name, each in table.items()}
        monkeypatch.setattr(program, "PARTS", table)
        monkeypatch.setattr(program, "parts", lambda seeds: asked_seeds.append(seeds) or table)
        for name in values:
            if name != "unstated":
                record.write(
                    name,
                    {"title": name, "figures": {"error": FIVE}, "steps": {}},
                    tmp_path / "stated",
                )
        return program.main()

    call.asked_seeds = asked_seeds
    return call


def test_a_quick_run_passes_if_each_figure_lies_inside(quick_run, tmp_path, capsys):
    assert quick_run({"one": 3.5, "two": 2.5}) == 0
    assert (
        "PASS: 2 figures inside their intervals, 0 outside (by chance at most 1), 0 missing"
        in capsys.readouterr().out.splitlines()[-1]
    )
    report = json.loads((tmp_path / "quick/report.json").read_text())
    assert report["commit"] == "c4"
    assert report["parts"]["one"]["figures"]["error"]["verdict"] == "inside"
    assert report["parts"]["one"]["figures"]["error"]["values"] == [3.5]


def test_a_quick_run_fails_if_a_figure_lies_outside(quick_run, capsys):
    assert quick_run({"one": 3.5, "two": 250}) == 1
    output = capsys.readouterr().out
    assert "outside: two.error = 250 N; stated 3 ± 1.963; expected -1.809 to 7.809" in output
    assert "FAIL: 1 figures inside their intervals, 1 outside" in output.splitlines()[-1]


def test_a_part_that_fails_does_not_stop_the_others_of_a_quick_run(quick_run, capsys):
    assert quick_run({"one": "fail", "two": 3, "three": "text", "unstated": 1}) == 1
    output = capsys.readouterr().out
    assert "FAILED: one failed with exit code 3" in output
    assert "FAILED: its files are not as expected" in output
    assert "FAILED: no results/unstated.json to compare with" in output
    assert output.splitlines()[-1][6:].startswith("FAIL: 1 figures inside")
    assert output.splitlines()[-1].endswith(
        "0 outside (by chance at most 1), 0 missing; failed: one, three, unstated"
    )


def test_a_step_behind_one_that_failed_is_not_run(git, script, tmp_path):
    chained = (
        step("first", f"python {script} first fail", 1),
        step("second", f"python {script} second 1 first", 1),
        step("third", f"python {script} third 1 second", 1),
    )
    failures = quick.run_steps(Runner(tmp_path, chained), lambda line: None)
    assert failures["second"] == "second needs first, which failed"
    assert failures["third"] == "third needs second, which failed"
    assert not (tmp_path / "third").exists()


def test_a_quick_run_reports_parts_that_it_cannot_run(quick_run, capsys):
    assert quick_run({"one": 3, "bench-two": 3, "three": 3}, three="no_such_module") == 0
    output = capsys.readouterr().out
    assert "not run: measures times alone" in output
    assert "not run: no_such_module is not installed" in output
    assert "PASS: 1 figures" in output.splitlines()[-1]
    assert output.splitlines()[-1].endswith("not run: bench-two, three")


def test_a_quick_run_that_compares_nothing_fails(quick_run):
    assert quick_run({"one": 3}, one="no_such_module") == 1


def test_a_quick_run_continues_if_it_was_stopped_and_else_starts_afresh(
    quick_run, tmp_path, capsys
):
    assert quick_run({"one": 3}) == 0
    (tmp_path / "quick/report.json").unlink()
    capsys.readouterr()
    assert quick_run({"one": 3}) == 0
    assert "common 0" not in capsys.readouterr().out
    assert quick_run({"one": 3}) == 0
    assert "common 0" in capsys.readouterr().out


def test_a_quick_run_takes_another_seed(quick_run, monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "argv", ["results", "--quick", "--seed", "15"])
    assert quick_run({"one": 3}) == 0
    assert quick_run.asked_seeds == [(15,)]
    assert json.loads((tmp_path / "quick/report.json").read_text())["seed"] == 15


def test_a_quick_run_leaves_out_benchmarks_alone_and_takes_an_hour_and_a_half():
    table = parts((quick.SEED,))
    left_out = {name for name in table if quick.find_reason_to_leave_out(name) is not None}
    assert left_out == {name for name in PARTS if name.startswith("bench-")}
    kept = {name: part for name, part in table.items() if name not in left_out}
    assert 45 < quick.estimate_minutes(kept, record.FOLDER) < 100
