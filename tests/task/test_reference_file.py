from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.task import signals
from softfin.task.signals import Recorded, read_reference_file

HEAD = "time_s,force_x_n,force_y_n\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "reference.csv"
    path.write_text(text)
    return path


def test_rows_are_held_between_their_times(tmp_path):
    signal = read_reference_file(written(tmp_path, HEAD + "0,1,-1\n0.5,2,0.5\n"))
    series = signal.sample(100)
    np.testing.assert_array_equal(series[:50], np.tile(np.float32([1, -1]), (50, 1)))
    np.testing.assert_array_equal(series[50:], np.tile(np.float32([2, 0.5]), (50, 1)))


def test_other_columns_their_order_and_empty_lines_do_not_matter(tmp_path):
    text = "\ufeffforce_y_n, note ,force_x_n,time_s\r\n-1,begin,1,0\r\n\r\n0,,2,3\r\n"
    assert read_reference_file(written(tmp_path, text)) == Recorded(
        time_s=(0, 3), force_n=((1, -1), (2, 0))
    )


@given(
    steps=st.lists(st.floats(0.01, 50), max_size=20),
    force=st.tuples(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)),
)
def test_a_file_gives_back_what_was_written_as_csv_and_as_parquet(tmp_path_factory, steps, force):
    folder = tmp_path_factory.mktemp("reference")
    times = np.concatenate([[0.0], np.cumsum(steps)]).tolist()
    forces = [(force[0] + k, force[1] - k) for k in range(len(times))]
    rows = "".join(f"{t!r},{x!r},{y!r}\n" for t, (x, y) in zip(times, forces, strict=True))
    columns = {
        "time_s": times,
        "force_x_n": [x for x, _ in forces],
        "force_y_n": [y for _, y in forces],
    }
    pq.write_table(pa.table({**columns, "angle_rad": times}), folder / "reference.parquet")
    wanted = Recorded(time_s=tuple(times), force_n=tuple(forces))
    assert read_reference_file(written(folder, HEAD + rows)) == wanted
    assert read_reference_file(folder / "reference.parquet") == wanted


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "not a table of numbers"),
        (HEAD, "has 0 rows"),
        (HEAD + "0,1,1\n\n2,nan,1\n", "row 2, column force_x_n: nan"),
        (HEAD + "0,1,1\n2,1,-inf\n", "row 2, column force_y_n: -inf"),
        (HEAD + "0,1,1\n2,1,\n", "row 2, column force_y_n: nan"),
        (HEAD + "0,1,1\n2,1\n", "got 2: 2,1"),
        (HEAD + "0,1,1\n2,one,1\n", "'one'"),
        (HEAD + "0,1,1\n2,1,1\n2,1,1\n", "time 2 s after 2 s"),
        (HEAD + "0,1,1\n2,1,1\n1,1,1\n", "time 1 s after 2 s"),
        (HEAD + "3,1,1\n4,1,1\n", "first time is 3 s"),
        ("time_s,force_x_kn,force_y_n\n0,1,1\n", "column force_x_n, .* force_x_kn"),
        ("time_ms,force_x_n,force_y_n\n0,1,1\n", "column time_s, .* time_ms"),
        ("time_s,force_x_n,torque\n0,1,1\n", "column force_y_n, .* torque"),
        ("time_s,time_s,force_x_n,force_y_n\n0,0,1,1\n", "column time_s, .* time_s, time_s"),
    ],
)
def test_what_cannot_be_asked_for_is_refused_in_one_line(tmp_path, text, words):
    path = written(tmp_path, text)
    with pytest.raises(ConfigurationError, match=words) as refused:
        read_reference_file(path)
    assert str(refused.value).startswith(f"--reference-file {path}: ")
    assert "\n" not in str(refused.value)


def test_a_parquet_file_is_held_to_the_same(tmp_path):
    path = tmp_path / "reference.parquet"
    columns = {"time_s": [0.0, 1.0], "force_x_n": [1.0, None], "force_y_n": [0.0, 0.0]}
    pq.write_table(pa.table(columns), path)
    with pytest.raises(ConfigurationError, match="row 2, column force_x_n: nan"):
        read_reference_file(path)
    path.write_bytes(b"PAR1 no")
    with pytest.raises(ConfigurationError, match="not a table of numbers"):
        read_reference_file(path)


def test_a_file_that_is_not_there_or_of_another_kind_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"none\.csv: cannot be read"):
        read_reference_file(tmp_path / "none.csv")
    with pytest.raises(ConfigurationError, match=r"reference\.txt: "):
        read_reference_file(tmp_path / "reference.txt")


def test_a_log_of_softfin_begins_a_tick_late_and_is_read(tmp_path):
    recorded = read_reference_file(written(tmp_path, HEAD + "0.01,1,0\n0.02,2,0\n"))
    assert recorded == Recorded(time_s=(0, 0.02), force_n=((1, 0), (2, 0)))


def test_milliseconds_are_not_taken_for_seconds(tmp_path):
    with pytest.raises(ConfigurationError, match="time_s up to 2000"):
        read_reference_file(written(tmp_path, HEAD + "0,1,0\n2000,2,0\n"))


@pytest.mark.parametrize("name", ["a.csv", "a.parquet"])
def test_a_reference_of_more_rows_than_an_hour_has_is_refused(tmp_path, monkeypatch, name):
    columns = {"time_s": np.arange(101.0), "force_x_n": np.zeros(101), "force_y_n": np.zeros(101)}
    if name == "a.csv":
        (tmp_path / name).write_text("time_s,force_x_n,force_y_n\n" + "0,0,0\n" * 101)
    else:
        pq.write_table(pa.table(columns), tmp_path / name)
    assert signals.MAX_REFERENCE_ROWS == 360_000
    monkeypatch.setattr(signals, "MAX_REFERENCE_ROWS", 100)
    with pytest.raises(ConfigurationError, match="has 101 rows"):
        read_reference_file(tmp_path / name)
