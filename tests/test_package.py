"""The files about the project agree with one another and with what they name."""

import re
import tomllib

import yaml

from tests.documents import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
MAKEFILE = (ROOT / "Makefile").read_text()


def test_citation_and_changes_are_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]
    assert citation["authors"] == PROJECT["authors"]
    assert [paper["url"] for paper in citation["references"]] == [PROJECT["urls"]["Paper"]]
    assert re.search(
        rf"^## {re.escape(PROJECT['version'])}\b", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE
    )


def test_before_a_commit_runs_what_make_lint_runs():
    recipe = re.search(r"^lint:.*\n((?:\t.*\n)+)", MAKEFILE, re.MULTILINE)[1]
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())["repos"][0]["hooks"]
    assert [hook["entry"].removeprefix(".venv/bin/") for hook in hooks] == re.findall(
        r"\$\(RUN\) (.*)", recipe
    )
    assert not any(hook["pass_filenames"] for hook in hooks)


def test_the_image_runs_targets_that_there_are():
    text = (ROOT / "Containerfile").read_text()
    targets = re.findall(r"^(?:RUN make |CMD \[\"make\", \")([\w-]+)", text, re.MULTILINE)
    assert targets == ["setup", "test-quick"]
    for target in targets:
        assert re.search(rf"^{target}:", MAKEFILE, re.MULTILINE)


def test_a_report_of_a_problem_asks_for_the_doctor():
    text = (ROOT / ".github/ISSUE_TEMPLATE/problem.md").read_text()
    fields = yaml.safe_load(text.split("---")[1])
    assert {"name", "about"} <= set(fields)
    assert "softfin doctor --rig rig.yaml" in text
