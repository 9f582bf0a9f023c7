"""A test that misses what it needs is skipped, and fails where that is required."""

import re

import pytest

from tests import needs
from tests.documents import ROOT


@pytest.fixture(params=["", "node", "chromium  node"])
def listed(request, monkeypatch):
    monkeypatch.setenv("SOFTFIN_REQUIRE", request.param)
    return request.param.split()


def test_what_is_missing_skips_a_test_unless_it_is_required(listed):
    outcome = pytest.fail.Exception if "node" in listed else pytest.skip.Exception
    with pytest.raises(outcome, match="node is not on PATH"):
        needs.give_up("node", "node is not on PATH")


def test_what_is_not_listed_may_be_missing(listed):
    with pytest.raises(pytest.skip.Exception):
        needs.give_up("published", "the published files are not here")


def test_a_module_that_is_there_is_imported_and_another_one_is_missing(monkeypatch):
    assert needs.module("json", "never").__name__ == "json"
    monkeypatch.setattr(needs, "NAMES", ("no_such_module",))
    monkeypatch.setenv("SOFTFIN_REQUIRE", "no_such_module")
    with pytest.raises(
        pytest.fail.Exception, match="not installed; SOFTFIN_REQUIRE lists no_such_module"
    ):
        needs.module("no_such_module", "not installed")


def test_an_unknown_name_is_refused(monkeypatch):
    monkeypatch.setenv("SOFTFIN_REQUIRE", "node chrome")
    with pytest.raises(pytest.UsageError, match="SOFTFIN_REQUIRE: chrome unknown; use chromium, "):
        needs.required()


def test_continuous_integration_requires_all_of_it():
    text = (ROOT / ".ci/run").read_text()
    (listed,) = re.findall(
        r"^export SOFTFIN_REQUIRE=\$\{SOFTFIN_REQUIRE-(.*)\}$", text, re.MULTILINE
    )
    # Ray has a job of its own.
    assert {*listed.split(), "ray"} == set(needs.NAMES)
    assert 'SOFTFIN_REQUIRE="$SOFTFIN_REQUIRE ray" make test-ray' in text
