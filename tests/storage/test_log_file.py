import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from softfin.core.errors import InputError, LogError
from softfin.core.quantities import Command, Log, Reading
from softfin.storage.log_file import SCHEMA, encode_log, read_log, write_log


def make_log(rows: int = 300, seed: int = 0) -> Log:
    random = np.random.default_rng(seed).normal(size=(6, rows)).astype(np.float32)
    time = np.arange(1, rows + 1) / 100
    return Log(
        Command(random[0], random[1]), Reading(time, random[2], random[3], random[4:].T.copy())
    )


@pytest.fixture
def table(tmp_path):
    write_log(tmp_path / "good.parquet", make_log())
    return pq.read_table(tmp_path / "good.parquet")


def with_column(table: pa.Table, name: str, values, kind=None) -> pa.Table:
    return table.set_column(table.schema.get_field_index(name), name, pa.array(values, kind))


def refusal(tmp_path, table: pa.Table) -> str:
    pq.write_table(table, tmp_path / "bad.parquet")
    with pytest.raises(LogError) as error:
        read_log(tmp_path / "bad.parquet")
    message = str(error.value)
    assert message.startswith(f"{tmp_path / 'bad.parquet'}: ")
    assert "\n" not in message
    return message


floats = st.floats(width=32, allow_nan=False, allow_infinity=False)


@settings(max_examples=25, deadline=None)
@given(values=hnp.arrays(np.float32, st.tuples(st.just(6), st.integers(1, 50)), elements=floats))
def test_what_is_written_is_read_again_bit_by_bit(values, tmp_path_factory):
    time = np.arange(1, values.shape[1] + 1) / 100
    log = Log(Command(values[0], values[1]), Reading(time, values[2], values[3], values[4:].T))
    path = tmp_path_factory.mktemp("log") / "log.parquet"
    write_log(path, log)
    again = read_log(path)
    columns = zip((*log.command, *log.reading), (*again.command, *again.reading), strict=True)
    for one, other in columns:
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype


def test_columns_carry_names_with_units_and_single_precision_but_for_time(table):
    commands = ["command_angle_rad", "command_velocity_rad_s"]
    readings = ["angle_rad", "velocity_rad_s", "force_x_n", "force_y_n"]
    assert table.schema.names == ["time_s", *commands, *readings]
    assert [str(kind) for kind in table.schema.types] == ["double"] + ["float"] * 6


def test_forces_keep_their_axes(tmp_path):
    log = make_log()
    write_log(tmp_path / "log.parquet", log)
    columns = pq.read_table(tmp_path / "log.parquet")
    np.testing.assert_array_equal(columns["force_x_n"], log.reading.force[:, 0])
    np.testing.assert_array_equal(columns["force_y_n"], log.reading.force[:, 1])


def test_columns_may_stand_in_any_order(tmp_path, table):
    pq.write_table(table.select(SCHEMA.names[::-1]), tmp_path / "turned.parquet")
    np.testing.assert_array_equal(
        read_log(tmp_path / "turned.parquet").reading.force, make_log().reading.force
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_log_with_nan_is_refused_with_its_row(tmp_path, table, value):
    force = table["force_y_n"].to_numpy().copy()
    force[[123, 200]] = value
    message = refusal(tmp_path, with_column(table, "force_y_n", force))
    assert f"row 123, column force_y_n: {value} (the first of 2 " in message


def test_an_empty_cell_is_refused_with_its_row(tmp_path, table):
    angle = table["angle_rad"].to_pylist()
    angle[7] = None
    message = refusal(tmp_path, with_column(table, "angle_rad", angle, pa.float32()))
    assert "row 7, column angle_rad: nan (the only one " in message


def test_a_gap_is_refused_with_its_row_and_length(tmp_path, table):
    time = table["time_s"].to_numpy().copy()
    time[50:] += 0.37
    message = refusal(tmp_path, with_column(table, "time_s", time))
    assert "row 50, column time_s: 380.0 ms after row 49" in message


@pytest.mark.parametrize(
    ("shift", "shown"), [(-0.01, "0.5000 s repeats or precedes row 49 (0.5000 s)"), (-0.1, "0.41")]
)
def test_time_that_repeats_or_runs_back_is_refused(tmp_path, table, shift, shown):
    time = table["time_s"].to_numpy().copy()
    time[50:] += shift
    message = refusal(tmp_path, with_column(table, "time_s", time))
    assert "row 50, column time_s: " in message
    assert shown in message


@pytest.mark.parametrize("rate", [1.0, 50.0, 70.0, 98.5, 103.0, 1000.0])
def test_another_rate_is_refused_as_a_rate_and_not_as_gaps(tmp_path, table, rate):
    message = refusal(tmp_path, with_column(table, "time_s", np.arange(300) / rate))
    assert f"column time_s: {rate:.2f} Hz" in message


def test_time_in_milliseconds_is_refused(tmp_path, table):
    message = refusal(tmp_path, with_column(table, "time_s", np.arange(300) * 10.0))
    assert "with time_s in seconds" in message


def test_a_clock_that_starts_anywhere_and_jitters_is_taken(tmp_path, table):
    jitter = np.random.default_rng(1).uniform(-0.002, 0.002, 300)
    time = 1.7e9 + np.arange(300) / 100 + jitter
    pq.write_table(with_column(table, "time_s", time), tmp_path / "log.parquet")
    np.testing.assert_array_equal(read_log(tmp_path / "log.parquet").reading.time, time)


def test_a_missing_column_is_named_with_those_that_are_there(tmp_path, table):
    names = [name.replace("force_x_n", "force_x") for name in SCHEMA.names]
    message = refusal(tmp_path, table.rename_columns(names))
    assert "column 'force_x_n' is missing; the file has ['time_s', " in message
    assert "'force_x', " in message


def test_a_repeated_column_is_refused(tmp_path, table):
    message = refusal(tmp_path, table.append_column("angle_rad", table["angle_rad"]))
    assert "column 'angle_rad' is repeated" in message


def test_channels_are_read_as_they_were_written_in_alphabetical_order(tmp_path):
    random = np.random.default_rng(1).normal(size=(3, 300)).astype(np.float32)
    channels = dict(zip(("torque_nm", "current_a", "Temp [C]"), random, strict=True))
    write_log(tmp_path / "log.parquet", make_log()._replace(channels=channels))
    again = read_log(tmp_path / "log.parquet")
    assert list(again.channels) == ["Temp [C]", "current_a", "torque_nm"]
    for name, values in again.channels.items():
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, channels[name])
    np.testing.assert_array_equal(again.reading.force, make_log().reading.force)


def test_a_log_without_channels_is_written_byte_for_byte_as_before():
    data = encode_log(make_log(), "log")
    assert encode_log(make_log()._replace(channels={}), "log") == data
    assert pq.read_schema(pa.BufferReader(data)).equals(SCHEMA, check_metadata=True)


@pytest.mark.parametrize("kind", [pa.int16(), pa.float64(), pa.bool_()])
def test_numeric_columns_of_other_programs_become_channels(tmp_path, table, kind):
    ticks = pa.array(np.arange(300) % 2).cast(kind)
    pq.write_table(table.append_column("valve", ticks), tmp_path / "log.parquet")
    valve = read_log(tmp_path / "log.parquet").channels["valve"]
    assert valve.dtype == np.float32
    np.testing.assert_array_equal(valve, np.arange(300) % 2)


def test_a_column_of_text_is_refused(tmp_path, table):
    message = refusal(tmp_path, table.append_column("note", pa.array(["calm"] * 300)))
    assert "column note is string, but must be float; remove it" in message


def test_a_channel_cannot_replace_a_column_of_every_log(tmp_path):
    log = make_log()._replace(channels={"angle_rad": np.zeros(300)})
    with pytest.raises(LogError, match="channel angle_rad is a column of every log"):
        write_log(tmp_path / "log.parquet", log)


def test_a_channel_that_is_not_finite_is_not_written(tmp_path):
    log = make_log()._replace(channels={"current_a": np.full(300, np.nan)})
    with pytest.raises(LogError, match="row 0, column current_a: nan"):
        write_log(tmp_path / "log.parquet", log)


def test_a_column_whose_name_is_not_text_is_one_line(tmp_path, table):
    pq.write_table(table, tmp_path / "a.parquet", store_schema=False)
    (tmp_path / "a.parquet").write_bytes(
        (tmp_path / "a.parquet").read_bytes().replace(b"force_x_n", b"force_\xff_n")
    )
    with pytest.raises(LogError, match=r"a\.parquet: .*utf-8") as error:
        read_log(tmp_path / "a.parquet")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("name", "kind"),
    [("angle_rad", pa.float64()), ("force_x_n", pa.string()), ("time_s", pa.float32())],
)
def test_another_type_is_refused(tmp_path, table, name, kind):
    message = refusal(tmp_path, with_column(table, name, table[name].cast(kind)))
    assert f"column {name} is {kind}, but must be " in message


def test_an_empty_log_is_refused(tmp_path, table):
    assert "empty" in refusal(tmp_path, table.slice(0, 0))


def test_a_truncated_file_is_refused_as_such(tmp_path, table):
    whole = (tmp_path / "good.parquet").read_bytes()
    for length in (0, 3, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.parquet").write_bytes(whole[:length])
        with pytest.raises(LogError, match=r"cut\.parquet: truncated, or not a Parquet file"):
            read_log(tmp_path / "cut.parquet")


def test_a_damaged_file_is_refused(tmp_path, table):
    whole = bytearray((tmp_path / "good.parquet").read_bytes())
    whole[len(whole) // 3 : len(whole) // 3 + 200] = bytes(200)
    (tmp_path / "bad.parquet").write_bytes(whole)
    with pytest.raises(LogError):
        read_log(tmp_path / "bad.parquet")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(LogError, match=r"/none\.parquet: cannot be read \(No such file"):
        read_log(tmp_path / "none.parquet")


def test_a_log_that_would_be_refused_is_not_written(tmp_path):
    log = make_log()
    log.reading.force[5, 0] = np.nan
    with pytest.raises(InputError, match="row 5, column force_x_n: nan"):
        write_log(tmp_path / "log.parquet", log)
    assert not any(tmp_path.iterdir())
