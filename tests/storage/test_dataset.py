import errno
import json
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from softfin.core.errors import ArtifactError, LogError, RunError
from softfin.core.quantities import Command, Log, Reading
from softfin.storage.dataset import Dataset, write_dataset


def make_log(seed: int, rows: int = 40) -> Log:
    random = np.random.default_rng(seed).normal(size=(6, rows)).astype(np.float32)
    time = np.arange(1, rows + 1) / 100
    return Log(
        Command(random[0], random[1]), Reading(time, random[2], random[3], random[4:].T.copy())
    )


@pytest.fixture
def dataset(tmp_path) -> Dataset:
    return write_dataset(
        tmp_path / "data", map(make_log, range(3)), map(make_log, [7]), {"plant": "none"}
    )


def test_a_dataset_names_its_logs_in_order(dataset):
    names = [path.relative_to(dataset.path).as_posix() for path in dataset.train]
    assert names == [f"train/000{index}.parquet" for index in range(3)]
    assert [path.name for path in dataset.test] == ["000.parquet"]
    paths = [*dataset.train, *dataset.test]
    for path, log in zip(paths, dataset.load(paths), strict=True):
        seed = {"train": 0, "test": 7}[path.parent.name] + int(path.stem)
        np.testing.assert_array_equal(log.reading.force, make_log(seed).reading.force)


def test_logs_keep_their_channels(tmp_path):
    torque = np.linspace(0, 1, 40, dtype=np.float32)
    log = make_log(0)._replace(channels={"torque_nm": torque})
    dataset = write_dataset(tmp_path / "data", [log, make_log(1)], [], {})
    first, second = dataset.load(dataset.train)
    np.testing.assert_array_equal(first.channels["torque_nm"], torque)
    assert second.channels == {}


def test_its_description_says_what_it_holds(dataset):
    written = json.loads((dataset.path / "dataset.json").read_text())
    assert written == dataset.description
    assert written["plant"] == "none"
    assert written["rate_hz"] == 100
    assert written["data_hash"] == dataset.data_hash
    assert len(written["files"]) == 4


def test_the_same_logs_have_the_same_hash_wherever_they_lie(dataset, tmp_path):
    again = write_dataset(
        tmp_path / "again", map(make_log, range(3)), map(make_log, [7]), {"plant": "another name"}
    )
    assert again.data_hash == dataset.data_hash


def test_other_logs_or_another_order_have_another_hash(dataset, tmp_path):
    other = write_dataset(tmp_path / "other", map(make_log, [0, 2, 1]), map(make_log, [7]), {})
    fewer = write_dataset(tmp_path / "fewer", map(make_log, range(3)), [], {})
    assert len({dataset.data_hash, other.data_hash, fewer.data_hash}) == 3


def test_logs_of_others_need_only_an_empty_description(dataset, tmp_path):
    mine = tmp_path / "mine"
    (mine / "train").mkdir(parents=True)
    shutil.copy(dataset.train[1], mine / "train" / "monday.parquet")
    (mine / "dataset.json").write_text("{}")
    opened = Dataset.open(mine)
    assert [path.name for path in opened.train] == ["monday.parquet"]
    assert opened.test == ()
    assert len(opened.data_hash) == 64


@pytest.mark.parametrize(
    ("harm", "named"),
    [
        (lambda d: d.train[1].unlink(), "train/0001.parquet: missing"),
        (lambda d: shutil.copy(d.train[0], d.path / "train/0003.parquet"), "0003.parquet: new"),
        (lambda d: d.test[0].write_bytes(b"PAR1"), "test/000.parquet: truncated or changed"),
        (lambda d: (d.path / "dataset.json").write_text('{"files": 3}'), "'files'"),
        (lambda d: (d.path / "dataset.json").unlink(), "not a dataset"),
        (lambda d: shutil.rmtree(d.path / "train"), "train"),
        (lambda d: shutil.rmtree(d.path), "no such folder"),
    ],
)
def test_a_dataset_that_is_not_whole_is_refused_by_what_is_wrong(dataset, harm, named):
    harm(dataset)
    with pytest.raises(ArtifactError, match=re.escape(named)):
        Dataset.open(dataset.path)


def test_a_dataset_without_logs_says_where_they_belong(tmp_path):
    (tmp_path / "dataset.json").write_text("{}")
    with pytest.raises(ArtifactError, match=str(tmp_path / "train")):
        Dataset.open(tmp_path)


def test_a_bad_log_leaves_no_folder(tmp_path):
    bad = make_log(1)
    bad.reading.angle[3] = np.nan
    with pytest.raises(LogError, match=r"/data/train/0001\.parquet: row 3, column angle_rad"):
        write_dataset(tmp_path / "data", [make_log(0), bad], [], {})
    assert not any(tmp_path.iterdir())


def test_a_full_disk_leaves_no_folder_and_names_the_place(tmp_path, monkeypatch):
    def full(path, data):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(RunError, match=r"/data: cannot be written \(No space left on device\)"):
        write_dataset(tmp_path / "data", [make_log(0)], [], {})
    assert not any(tmp_path.iterdir())


def test_a_folder_of_someone_else_is_not_replaced(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("years of work")
    with pytest.raises(ArtifactError, match=r"not a softfin folder"):
        write_dataset(tmp_path / "home", [make_log(0)], [], {}, overwrite=True)
    assert (tmp_path / "home" / "thesis.txt").read_text() == "years of work"
