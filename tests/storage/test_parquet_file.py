import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from softfin.core.errors import ConfigurationError, LogError
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.tables import read_table
from softfin.storage import parquet_file
from softfin.storage.log_file import SCHEMA, read_log
from softfin.task import reference_file


def table(rows, **others):
    return pa.table({name: np.zeros(rows) for name in SCHEMA.names} | others)


def imported(path):
    return read_table(path, path.name, "train", ImportConfig())


READERS = pytest.mark.parametrize("read", [read_log, imported])


@READERS
def test_a_file_of_more_rows_than_any_recording_is_refused_before_they_are_read(tmp_path, monkeypatch, read):
    pq.write_table(table(2000), tmp_path / "a.parquet")
    monkeypatch.setattr(parquet_file, "MOST_ROWS", 1999)
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_: pytest.fail("its rows were read"))
    with pytest.raises(LogError, match=r"a\.parquet: has 2,000 rows; at most 1,999 are read; cut it into"):
        read(tmp_path / "a.parquet")


@READERS
def test_a_pipe_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "a.parquet")
    with pytest.raises(LogError, match=r"a\.parquet: cannot be read \(a pipe, not a file\)"):
        read(tmp_path / "a.parquet")


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_a_reference_of_more_rows_than_an_hour_has_is_refused(tmp_path, monkeypatch, name):
    columns = {"time_s": np.arange(101.0), "force_x_n": np.zeros(101), "force_y_n": np.zeros(101)}
    if name == "a.csv":
        (tmp_path / name).write_text("time_s,force_x_n,force_y_n\n" + "0,0,0\n" * 101)
    else:
        pq.write_table(pa.table(columns), tmp_path / name)
    assert reference_file.MOST_ROWS == 360_000
    monkeypatch.setattr(reference_file, "MOST_ROWS", 100)
    with pytest.raises(ConfigurationError, match="has 101 rows or more; at most 100 are followed"):
        reference_file.read_reference_file(tmp_path / name)


@READERS
def test_a_column_whose_name_is_no_text_is_one_line(tmp_path, read):
    pq.write_table(table(2), tmp_path / "a.parquet", store_schema=False)
    (tmp_path / "a.parquet").write_bytes((tmp_path / "a.parquet").read_bytes().replace(b"force_x_n", b"force_\xff_n"))
    with pytest.raises(LogError, match=r"a\.parquet: truncated, or not a Parquet file \(.*utf-8") as error:
        read(tmp_path / "a.parquet")
    assert "\n" not in str(error.value)
