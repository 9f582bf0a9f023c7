import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from softfin.core.errors import LogError
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.tables import read_table
from tests.data.faulty import tank_logs, to_columns

AUTHORS = {
    "command_angle_rad": "command angle",
    "command_velocity_rad_s": "command velocity",
    "angle_rad": "position",
    "force_x_n": "force x",
    "force_y_n": "force y",
}
MAPPED = (
    "angle=position,command_angle=command angle,command_velocity=command "
    "velocity,force_x=force x,force_y=force y"
)


@pytest.fixture(scope="module")
def columns():
    return to_columns(tank_logs()[0])


def write_csv(path, columns, delimiter=","):
    options = pyarrow.csv.WriteOptions(delimiter=delimiter)
    pyarrow.csv.write_csv(pa.table(columns), path, options)


def authors(columns) -> dict:
    return {name: columns[own] for own, name in AUTHORS.items()}


def read(path, **options):
    return read_table(path, path.name, "train", ImportConfig.build(options))


def kinds(recording) -> list[str]:
    return [one.name for one in recording.issues]


def test_the_authors_csv_is_read_with_a_mapping_and_a_rate(tmp_path, columns):
    write_csv(tmp_path / "final.csv", authors(columns))
    (recording,) = read(tmp_path / "final.csv", columns=MAPPED, rate_hz=100)
    (track,) = recording.tracks
    np.testing.assert_allclose(track.channels["angle"], columns["angle_rad"])
    np.testing.assert_allclose(track.time, np.arange(6000) / 100)
    assert kinds(recording) == ["columns", "force unit", "velocity derived"]
    assert recording.issues[0].message.startswith(
        "command_angle='command angle' in rad (assumed), "
    )


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_delimiters_and_a_byte_order_mark_are_understood(tmp_path, columns, delimiter):
    write_csv(tmp_path / "a.csv", columns, delimiter)
    (tmp_path / "b.csv").write_bytes(b"\xef\xbb\xbf" + (tmp_path / "a.csv").read_bytes())
    (recording,) = read(tmp_path / "b.csv")
    np.testing.assert_allclose(recording.tracks[0].channels["force_y"], columns["force_y_n"])
    assert recording.issues == ()


def test_a_quoted_name_may_hold_the_delimiter(tmp_path, columns):
    write_csv(tmp_path / "a.csv", columns | {"forces, x and y": columns["time_s"]})
    (recording,) = read(tmp_path / "a.csv")
    assert "'forces, x and y'" in recording.issues[0].message


def test_logs_end_to_end_are_parted_by_their_rows(tmp_path, columns):
    write_csv(tmp_path / "final.csv", authors(columns))
    recordings = read(tmp_path / "final.csv", columns=MAPPED, rate_hz=100, rows_per_log=2500)
    assert [one.name for one in recordings] == [
        "final.csv rows 0..2499",
        "final.csv rows 2500..4999",
        "final.csv rows 5000..5999",
    ]
    np.testing.assert_allclose(
        recordings[1].tracks[0].channels["angle"], columns["angle_rad"][2500:5000]
    )


def test_columns_that_are_not_read_are_named(tmp_path, columns):
    write_csv(tmp_path / "a.csv", columns | {"temperature": columns["time_s"]})
    (recording,) = read(tmp_path / "a.csv")
    assert "'temperature'" in recording.issues[0].message


def test_empty_cells_are_not_a_number(tmp_path):
    text = "time,c,v,p,x,y\n0.00,0,1,0,,1\n0.01,0,1,nan,1,1\n0.02,0,1,1.#QNAN0,1,#N/A\n"
    rows = [f"{0.01 * row},0,1,0,1,1\n" for row in range(3, 50)]
    (tmp_path / "a.csv").write_text(text + "".join(rows))
    (recording,) = read(
        tmp_path / "a.csv",
        columns="time=time,command_angle=c,command_velocity=v,angle=p,force_x=x,force_y=y",
    )
    values = recording.tracks[0].channels
    assert np.isnan(values["force_x"]).tolist() == [True] + 49 * [False]
    assert np.isnan(values["angle"]).tolist() == [False, True, True] + 47 * [False]
    assert np.isnan(values["force_y"]).tolist() == [False, False, True] + 47 * [False]


def test_a_time_in_milliseconds_is_told(tmp_path, columns):
    write_csv(tmp_path / "a.csv", columns | {"time_s": 1000 * columns["time_s"]})
    (recording,) = read(tmp_path / "a.csv", time_unit="ms")
    np.testing.assert_allclose(recording.tracks[0].time, columns["time_s"])


@pytest.mark.parametrize("suffix", ["csv", "parquet"])
def test_units_in_the_names_are_converted_and_a_velocity_may_be_told(tmp_path, columns, suffix):
    table = {
        "t [ms]": 1e3 * columns["time_s"],
        "Cmd Angle (deg)": np.degrees(columns["command_angle_rad"]),
        "theta_deg": np.degrees(columns["angle_rad"]),
        "Fx [mN]": 1e3 * columns["force_x_n"],
        "F_y (mN)": 1e3 * columns["force_y_n"],
        "note": columns["time_s"],
    }
    path = tmp_path / f"a.{suffix}"
    write_csv(path, table) if suffix == "csv" else pq.write_table(pa.table(table), path)
    (recording,) = read(path, velocity_rad_s=3.1)
    (track,) = recording.tracks
    np.testing.assert_allclose(track.time, columns["time_s"])
    for own in ("command_angle_rad", "angle_rad", "force_y_n"):
        read_values = track.channels[own.rpartition("_")[0]]
        np.testing.assert_allclose(read_values, columns[own], atol=1e-12)
    assert set(track.channels["command_velocity"]) == {3.1}
    assert kinds(recording) == ["columns", "unread columns", "velocity derived"]
    assert "force_y='F_y (mN)' in mN; command_velocity = 3.1 rad/s" in recording.issues[0].message


def test_a_rate_or_velocity_that_is_not_used_is_said_so(tmp_path, columns):
    write_csv(tmp_path / "a.csv", columns)
    (recording,) = read(tmp_path / "a.csv", velocity_rad_s=3.1, rate_hz=100)
    np.testing.assert_array_equal(
        recording.tracks[0].channels["command_velocity"], columns["command_velocity_rad_s"]
    )
    assert "--velocity 3.1 ignored" in recording.issues[0].message
    assert "--rate 100 ignored" in recording.issues[0].message


def test_parquet_with_other_names_and_types_is_read(tmp_path, columns):
    table = pa.table({name: values.astype(np.float32) for name, values in authors(columns).items()})
    pq.write_table(table.append_column("n", pa.array(range(6000))), tmp_path / "a.parquet")
    (recording,) = read(tmp_path / "a.parquet", columns=MAPPED + ",time=n", time_unit="ms")
    np.testing.assert_allclose(recording.tracks[0].channels["angle"], columns["angle_rad"])
    assert recording.tracks[0].time[1] == pytest.approx(0.001)


HEADER = ",".join(AUTHORS)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no rows"),
        ("1,2,3\n4,5,6\n", "column names"),
        ("angle,angle,cmd,cmd vel,fx,fy\n1,2,3,4,5,6\n", "duplicate column 'angle'"),
        (f"{HEADER}\n", "no rows"),
        (f"{HEADER}\n1,2,3,4,x\n", "'force_y_n' contains no numbers"),
        (f"{HEADER}\n1,2,3\n", "no rows of numbers"),
    ],
)
def test_a_csv_that_is_no_table_is_refused_in_one_line(tmp_path, text, message):
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(LogError, match=message) as error:
        read(tmp_path / "a.csv", rate_hz=100)
    assert "\n" not in str(error.value)


def test_other_files_are_refused(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"no Parquet")
    (tmp_path / "a.csv").write_bytes(b"\xff\xfe\x00")
    pq.write_table(pa.table({name: ["a", "b"] for name in AUTHORS}), tmp_path / "b.parquet")
    for name in ("a.parquet", "a.csv", "b.parquet"):
        with pytest.raises(LogError, match=name):
            read(tmp_path / name, rate_hz=100)


FURTHER = {
    "Fz [N]": 2.0,
    "Tx [mNm]": 100.0,
    "Ty [mNm]": 200.0,
    "Tz [mNm]": 300.0,
    "motor current [mA]": 500.0,
    "Temp": 21.5,
    "valve": 1.0,
    "torque": 7.0,
}


def with_further(columns) -> dict:
    return columns | {name: np.full(6000, value) for name, value in FURTHER.items()}


def means(recording) -> dict[str, float]:
    """Further channels of a recording; each of them is constant."""
    (track,) = recording.tracks
    return {
        name: round(float(values.mean()), 9)
        for name, values in track.channels.items()
        if name[-2:] in ("_n", "nm", "_a", "_c", "ve", "mp")
    }


LOADS = "force_z=Fz [N],torque_x=Tx [mNm],torque_y=Ty [mNm]"

WRENCH = {"force_z_n": 2.0, "torque_x_nm": 0.1, "torque_y_nm": 0.2, "torque_nm": 0.3}


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_further_channels_are_recognized_by_name_and_unit(tmp_path, columns, suffix):
    path = tmp_path / f"run{suffix}"
    table = with_further(columns)
    if suffix == ".csv":
        write_csv(path, table)
    else:
        # Not softfin's own file, whose other columns are all channels.
        table["time [s]"] = table.pop("time_s")
        pq.write_table(pa.table(table), path)
    (recording,) = read(path, columns=LOADS)
    assert means(recording) == WRENCH | {"current_a": 0.5}
    read_columns, unread = recording.issues
    assert "torque='Tz [mNm]' in mNm, current='motor current [mA]' in mA" in read_columns.message
    # Without a unit, a torque could be a register of counts.
    assert unread.message == "columns not read: 'Temp', 'valve', 'torque'"


def test_other_numeric_columns_of_softfins_own_parquet_files_are_its_channels(tmp_path, columns):
    others = {"Temp": np.full(6000, 21.5), "valve": np.full(6000, 1), "time": np.full(6000, 3.0)}
    others |= {"torque_nm": np.full(6000, 0.3), "note": ["text"] * 6000}
    table = pa.table(columns | others)
    pq.write_table(table, tmp_path / "own.parquet")
    (recording,) = read(tmp_path / "own.parquet", columns="torque=-")
    assert means(recording) == {"Temp": 21.5, "valve": 1.0}
    assert recording.issues[0].message == "columns not read: 'time', 'torque_nm', 'note'"
    pq.write_table(table.drop_columns(["velocity_rad_s"]), tmp_path / "other.parquet")
    (recording,) = read(tmp_path / "other.parquet")
    assert means(recording) == {"torque_nm": 0.3}
    doubled = table.append_column("valve", table.column("valve"))
    pq.write_table(doubled, tmp_path / "doubled.parquet")
    with pytest.raises(LogError, match="duplicate column 'valve'; rename one of them"):
        read(tmp_path / "doubled.parquet")


def test_further_channels_follow_the_axes_of_the_force(tmp_path, columns):
    write_csv(tmp_path / "run.csv", with_further(columns))
    (recording,) = read(tmp_path / "run.csv", force="y,-x", columns=LOADS)
    assert means(recording) == WRENCH | {"torque_x_nm": 0.2, "torque_y_nm": -0.1, "current_a": 0.5}
    # A mirrored sensor faces the other way.
    (recording,) = read(tmp_path / "run.csv", force="y,x", negate="current", columns=LOADS)
    assert means(recording) == {
        "force_z_n": -2.0,
        "torque_x_nm": 0.2,
        "torque_y_nm": 0.1,
        "torque_nm": -0.3,
        "current_a": -0.5,
    }


def test_one_torque_of_two_is_not_read(tmp_path, columns):
    table = with_further(columns)
    del table["Ty [mNm]"]
    write_csv(tmp_path / "run.csv", table)
    (recording,) = read(tmp_path / "run.csv", columns="force_z=Fz [N],torque_x=Tx [mNm]")
    assert means(recording) == {"force_z_n": 2.0, "torque_nm": 0.3, "current_a": 0.5}


def test_current_and_torque_are_read_only_with_a_unit_and_a_column_of_text_is_no_channel(
    tmp_path, columns
):
    table = columns | {
        "current": np.full(6000, 20.0),
        "torque": np.full(6000, 5.0),
        "note_v": ["low"] * 6000,
    }
    write_csv(tmp_path / "run.csv", table)
    (recording,) = read(tmp_path / "run.csv")
    assert means(recording) == {}
