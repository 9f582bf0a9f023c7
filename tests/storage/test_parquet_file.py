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
    with pytest.raises(LogError, match=r"a\.parquet: has 2,000 rows or more; at most 1,999 are read; cut it into"):
        read(tmp_path / "a.parquet")


@READERS
def test_a_file_that_unpacks_to_more_than_is_read_is_refused_before_it_does(tmp_path, monkeypatch, read):
    # Plain: a dictionary of the one value would take no room at all.
    pq.write_table(table(20_000), tmp_path / "a.parquet", compression="zstd", use_dictionary=False)
    monkeypatch.setattr(parquet_file, "MOST_BYTES", 500_000)
    assert (tmp_path / "a.parquet").stat().st_size < 500_000
    with pytest.raises(LogError, match=r"a\.parquet: unpacks to 1,1\d\d,\d\d\d bytes; at most 500,000 are read"):
        read(tmp_path / "a.parquet")
    monkeypatch.setattr(parquet_file, "MOST_BYTES", 100)
    with pytest.raises(LogError, match=r"a\.parquet: cannot be read \(it has over 100 bytes\)"):
        read(tmp_path / "a.parquet")


@READERS
def test_a_file_of_more_columns_or_longer_names_than_any_log_is_refused(tmp_path, read):
    pq.write_table(table(2, **{f"c{i}": [1, 2] for i in range(1000)}), tmp_path / "a.parquet")
    with pytest.raises(LogError, match="has 1,007 columns; at most 1,000 are read"):
        read(tmp_path / "a.parquet")
    pq.write_table(table(2, **{"x" * 2000: [1, 2]}), tmp_path / "a.parquet")
    with pytest.raises(LogError, match="name has 2,000 letters"):
        read(tmp_path / "a.parquet")


@READERS
def test_a_pipe_is_not_waited_for(tmp_path, read):
    os.mkfifo(tmp_path / "a.parquet")
    with pytest.raises(LogError, match=r"a\.parquet: cannot be read \(a pipe, not a file\)"):
        read(tmp_path / "a.parquet")


def test_hours_at_a_kilohertz_are_within_the_bounds():
    assert parquet_file.MOST_ROWS >= 5 * 3600 * 1000
    assert parquet_file.MOST_BYTES >= parquet_file.MOST_ROWS * 8 * 10


def test_the_rows_of_a_csv_are_counted_as_they_come(tmp_path, monkeypatch):
    (tmp_path / "a.csv").write_text(",".join(SCHEMA.names) + "\n" + "0,0,1,0,0,0,0\n" * 2000)
    monkeypatch.setattr(parquet_file, "MOST_ROWS", 1999)
    with pytest.raises(LogError, match=r"a\.csv: has 2,000 rows or more; at most 1,999 are read"):
        imported(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("header", "words"),
    [("x" * 200_000, "first line has over 100,000 letters"), (",".join(f"c{i}" for i in range(1001)), "1,001 columns")],
)
def test_a_csv_whose_first_line_names_no_columns_is_refused(tmp_path, header, words):
    (tmp_path / "a.csv").write_text(header + "\n")
    with pytest.raises(LogError, match=words):
        imported(tmp_path / "a.csv")


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
