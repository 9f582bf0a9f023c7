"""Format numbers: one table, in code and in the documents; any other number is refused in
one line."""

import json
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from softfin.core.errors import ArtifactError, LogError
from softfin.rig.monitor.follow import Follower
from softfin.storage import artifact as artifacts
from softfin.storage import formats
from softfin.storage.bag import messages
from softfin.storage.bag.recovery import check_bag
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.formats import FOLDERS, FORMATS, check_format
from softfin.storage.log_file import read_log, write_log
from tests.data.recorded import record
from tests.documents import ROOT
from tests.surrogate.streaming import small


@pytest.mark.parametrize("number", [None, "3", 2, 4, 0, [], {"a": 1}])
def test_any_other_number_is_refused_with_the_way_out(number):
    check_format("controller", 3, "it")
    with pytest.raises(
        ArtifactError, match=r"it: format is .*, but this version of softfin reads 3; use the"
    ):
        check_format("controller", number, "it")


@pytest.mark.parametrize("kind", FOLDERS)
def test_each_folder_states_its_kind_and_number_first_and_is_checked_when_read(kind, tmp_path):
    artifacts.write_description(tmp_path, kind, {"more": 1})
    description = artifacts.load_description(tmp_path, kind)
    assert list(description.items()) == [
        ("kind", kind),
        ("format", FOLDERS[kind]),
        ("more", 1),
    ]
    artifacts.check_vacant(tmp_path, overwrite=True)
    (tmp_path / f"{kind}.json").write_text(json.dumps(description | {"format": 99}))
    with pytest.raises(ArtifactError, match=rf"{kind}\.json: format is '99', but this"):
        artifacts.load_description(tmp_path, kind)


def test_a_dataset_by_hand_needs_no_number(tmp_path):
    write_dataset(tmp_path / "d", [small.recorded(700)], [], {})
    (tmp_path / "d/dataset.json").write_text("{}")
    assert len(Dataset.open(tmp_path / "d").train) == 1


def test_a_log_of_a_newer_softfin_is_refused(tmp_path):
    file = tmp_path / "log.parquet"
    write_log(file, small.recorded(300))
    table = pq.read_table(file)
    for number, words in (
        ("2", "format is '2', but"),
        ("two", "format is 'two'"),
    ):
        pq.write_table(table.replace_schema_metadata({formats.IN_FILE: number}), file)
        with pytest.raises(LogError, match=rf"log\.parquet: {words}"):
            read_log(file)
    # As Pandas, or softfin before there were numbers, wrote them.
    for metadata in (None, {"pandas": "{}"}):
        pq.write_table(table.replace_schema_metadata(metadata), file)
        read_log(file)


def test_a_recording_of_a_newer_softfin_is_refused_by_all_who_read_it(tmp_path, monkeypatch):
    file = tmp_path / "run.mcap"
    record(file, rows=200)
    check_bag(file)
    file.unlink()
    monkeypatch.setattr(messages, "FILES", {"recording": 2})
    record(file, rows=200)
    with pytest.raises(
        LogError,
        match=r"run\.mcap: format is '2', but this version of softfin reads 1; use the version",
    ):
        check_bag(file)
    follower = Follower(file)
    follower.poll()
    assert "format is '2'" in str(follower.summary()["problem"])


def test_the_documents_list_every_kind_with_its_number():
    text = (ROOT / "docs/files.md").read_text()
    rows = re.findall(r"^\| `([\w-]+)` \| (\d+) \| .*\|$", text, re.MULTILINE)
    assert {kind: int(number) for kind, number in rows} == FORMATS


def test_every_description_is_written_and_read_in_one_place():
    """Nobody writes a KIND.json by hand, nor compares its number."""
    for file in Path(ROOT / "src/softfin").rglob("*.py"):
        text = file.read_text()
        for kind in FOLDERS:
            assert f'"{kind}.json").write_text' not in text, file
        if file.parent.name != "storage":
            assert 'get("format"' not in text, file
