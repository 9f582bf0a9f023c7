"""Text files as loggers, spreadsheets and power cuts leave them: what is read must be the log."""

import datetime

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from softfin.core.errors import LogError, NotALogError
from softfin.data.importing.clocks import build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.tables import read_table
from softfin.data.recordings import open_logs

ROWS = 300

NAMES = ("time", "cmd angle", "cmd velocity", "angle", "velocity", "Fx", "Fy")
UNITS = ("s", "deg", "deg/s", "deg", "deg/s", "N", "N")
HEADER = [f"{name} [{unit}]" for name, unit in zip(NAMES, UNITS, strict=True)]


def series() -> np.ndarray:
    """Columns of a log, in the units of HEADER."""
    time = (1 + np.arange(ROWS)) / 100
    motion = [np.full(ROWS, 20.0), np.full(ROWS, 90.0), 20 * np.sin(time), 20 * np.cos(time)]
    return np.array([time, *motion, np.sin(3 * time), 2 * np.cos(3 * time)])


def cells(values: np.ndarray) -> list[list[str]]:
    return [[f"{value:.5f}" for value in row] for row in values.T]


def joined(rows, delimiter=",", end="\n") -> str:
    return "".join(delimiter.join(row) + end for row in rows)


PLAIN = joined([HEADER, *cells(series())])


def read(path, content, **options):
    if isinstance(content, str):
        content = content.encode()
    path.write_bytes(content)
    return read_table(path, path.name, "train", ImportConfig.build(options))


def kinds(recordings) -> list[tuple[str, str]]:
    issues = [one for recording in recordings for one in recording.issues]
    return [(one.severity, one.name) for one in issues if one.name != "columns"]


def check_values(recording, rows=slice(None)) -> None:
    (track,) = recording.tracks
    time, *motion, x, y = series()[:, rows]
    np.testing.assert_allclose(track.time - track.time[0], time - time[0], atol=2e-5)
    found = list(track.channels.values())
    for values, expected in zip(found, [*np.radians(motion), x, y], strict=True):
        np.testing.assert_allclose(values, expected, atol=2e-5)


def in_columns(text: str) -> str:
    """With several spaces between the columns, and some at the start of each line."""
    lines = text.replace("cmd angle", "cmd_angle").replace("cmd velocity", "cmd_velocity")
    return "".join(f"  {line}\n" for line in lines.replace(",", "   ").splitlines())


def with_times(to_text, name="timestamp") -> str:
    start = datetime.datetime(2025, 3, 5, 23, 59, 59)
    rows = cells(series())
    for index, row in enumerate(rows):
        row[0] = to_text(start + datetime.timedelta(milliseconds=10 * index))
    return joined([[*name.split(","), *HEADER[1:]], *rows])


def half_days(moment: datetime.datetime) -> str:
    return moment.strftime("%d/%m/%Y %I:%M:%S.%f %p")


UNITS_BELOW = joined([NAMES, UNITS, *cells(series())])
BRACKETS_BELOW = joined([NAMES, [f"[{unit}]" for unit in UNITS], *cells(series())])
DEGREES = PLAIN.replace("deg", "°")
WITHOUT_HEADER = PLAIN.split("\n", 1)[1]
LINES = PLAIN.splitlines()

SAME = {
    "decimal commas": PLAIN.replace(",", ";").replace(".", ","),
    "decimal commas, tabs": PLAIN.replace(",", "\t").replace(".", ","),
    "decimal commas in quotes": joined(
        [HEADER, *[[f'"{cell}"'.replace(".", ",") for cell in row] for row in cells(series())]]
    ),
    "line of the delimiter": "sep=;\n" + PLAIN.replace(",", ";"),
    "line of the delimiter, commas": "sep=,\r\n" + PLAIN.replace("\n", "\r\n"),
    "units below": UNITS_BELOW,
    "units in brackets below": BRACKETS_BELOW,
    "units below, tabs": UNITS_BELOW.replace(",", "\t"),
    "comments": "# Logger 2.1\n# A, B, C\n\n" + PLAIN,
    "preamble": "Logger,2.1\nOperator,A. B.\nGain,3\n\n" + PLAIN,
    "header in a comment": "# " + PLAIN,
    "delimiter at the end of rows": joined([HEADER]) + joined(cells(series()), end=",\n"),
    "delimiter at the end of the header": joined([HEADER], end=",\n") + WITHOUT_HEADER,
    "delimiter at the end": PLAIN.replace("\n", ",\n"),
    "no end of the last line": PLAIN[:-1],
    "comments in between": PLAIN.replace(LINES[9], "# marker\n\n" + LINES[9]),
    "cp1252": DEGREES.encode("cp1252"),
    "UTF-16": DEGREES.encode("utf-16"),
    "UTF-16, big-endian": b"\xfe\xff" + DEGREES.encode("utf-16-be"),
    "UTF-16 without a mark": DEGREES.encode("utf-16-le"),
    "UTF-16, big-endian without a mark": DEGREES.encode("utf-16-be"),
    "UTF-16 after a line of other letters": ("測定\n" + DEGREES).encode("utf-16-le"),
    "UTF-32": DEGREES.encode("utf-32"),
    "UTF-32 without a mark": DEGREES.encode("utf-32-be"),
    "NUL at the start": b"\0" * 301 + DEGREES.encode(),
    "units above": joined([UNITS, NAMES, *cells(series())]),
    "hash before a header with spaces": "# " + in_columns(PLAIN).lstrip(),
    "UTF-8 with a mark": DEGREES.encode("utf-8-sig"),
    "carriage returns": PLAIN.replace("\n", "\r"),
    "bars": PLAIN.replace(",", "|"),
    "spaces": in_columns(PLAIN),
    "spaces within names": PLAIN.replace(",", "    "),
    "dates": with_times(str),
    "dates with T": with_times(datetime.datetime.isoformat),
    "dates with AM and PM": with_times(half_days, "Date Time"),
    "dates and times": with_times(lambda moment: str(moment).replace(" ", ","), "Date,Time"),
    "dates without separators": with_times(lambda moment: moment.strftime("%Y%m%dT%H%M%S.%f")),
    "minutes": with_times(lambda moment: moment.strftime("%M:%S.%f"), "time"),
    "milliseconds after a colon": with_times(
        lambda moment: moment.strftime("%H:%M:%S:%f")[:-3], "time"
    ),
    "dates, decimal commas": with_times(str).replace(",", ";").replace(".", ","),
}


@pytest.mark.parametrize("content", SAME.values(), ids=SAME.keys())
def test_a_table_is_read_however_it_is_written(tmp_path, content):
    (recording,) = recordings = read(tmp_path / "run.csv", content)
    check_values(recording)
    assert [kind for kind in kinds(recordings) if kind != ("note", "unread columns")] == []


@pytest.mark.parametrize(
    ("content", "rows"),
    [
        (PLAIN[:-20], slice(ROWS - 1)),
        (PLAIN[:-3], slice(ROWS - 1)),
        (PLAIN.replace(",", ";").replace(".", ",")[:-3], slice(ROWS - 1)),
        (PLAIN + 300 * "\0", slice(None)),
        (PLAIN[:-60] + 300 * "\0", slice(ROWS - 1)),
        (PLAIN.replace(LINES[9], LINES[9][:12] + LINES[9]), np.r_[:8, 9:ROWS]),
        (PLAIN.replace(LINES[9], "ERROR: timeout"), np.r_[:8, 9:ROWS]),
        (PLAIN.replace(LINES[1], LINES[1][20:]), slice(1, ROWS)),
        (PLAIN.replace(LINES[90], '"' + LINES[90][:20]), np.r_[:89, 90:ROWS]),
        (PLAIN + "end of recording\n", slice(None)),
    ],
    ids=[
        "cut",
        "cut in a number",
        "cut, decimal commas",
        "NUL",
        "cut and NUL",
        "two lines in one",
        "text",
        "first",
        "quote",
        "footer",
    ],
)
def test_lines_that_are_no_rows_are_dropped_with_a_warning(tmp_path, content, rows):
    (recording,) = recordings = read(tmp_path / "run.csv", content)
    check_values(recording, rows)
    assert kinds(recordings) == [("warning", "dropped rows")]


@pytest.mark.parametrize("text", ["nan", "1.#QNAN0", "#N/A", "--", "OL"])
def test_texts_in_place_of_numbers_are_missing_values_with_a_warning(tmp_path, text):
    values = cells(series())
    values[50][5] = text
    recordings = read(tmp_path / "run.csv", joined([HEADER, *values]))
    assert np.flatnonzero(np.isnan(recordings[0].tracks[0].channels["force_x"])).tolist() == [50]
    _, issues = build_logs(recordings[0], ImportConfig())
    (issue,) = [one for one in issues if one.name == "not a number"]
    assert (issue.severity, issue.column, issue.row) == ("warning", "force_x", 50)


@pytest.mark.parametrize("again", [PLAIN, PLAIN.replace("\n", ",\n"), UNITS_BELOW])
def test_a_repeated_header_starts_a_new_log(tmp_path, again):
    first, second = recordings = read(tmp_path / "run.csv", again + again)
    check_values(first)
    assert len(second.tracks[0].time) >= ROWS
    logs, _ = build_logs(second, ImportConfig())
    assert [one.log.rows for one in logs] == [ROWS]
    assert [one.name for one in recordings] == [
        f"run.csv rows 0..{ROWS - 1}",
        f"run.csv rows {ROWS}..{ROWS + len(second.tracks[0].time) - 1}",
    ]


def test_a_doubled_column_is_an_error_only_if_it_is_needed(tmp_path):
    values = np.vstack([series(), series()[:2]])
    table = joined([[*HEADER, "note", "note"], *cells(values)])
    check_values(read(tmp_path / "run.csv", table)[0])
    with pytest.raises(LogError, match="duplicate column"):
        read(tmp_path / "run.csv", joined([[*HEADER, "Fx [N]", "note"], *cells(values)]))


def merged(tmp_path, ordered: bool):
    """Motor at 100 Hz, force at 1 kHz 0.3 ms later, and commands only where they change."""
    motor = (1 + np.arange(ROWS)) / 100
    force = np.arange(0.0103, motor[-1], 0.001)
    rows = [(0.0102, f"{0.0102},20,90,,,,")]
    rows += [(t, f"{t:.4f},,,{20 * np.sin(t):.5f},{20 * np.cos(t):.5f},,") for t in motor]
    rows += [(t, f"{t:.4f},,,,,{np.sin(t):.5f},{np.cos(t):.5f}") for t in force]
    if ordered:
        rows.sort()
    return read(tmp_path / "run.csv", joined([HEADER]) + joined([[row] for _, row in rows]))


@pytest.mark.parametrize("ordered", [True, False])
def test_in_a_table_merged_from_several_sources_each_channel_keeps_its_times(tmp_path, ordered):
    (recording,) = recordings = merged(tmp_path, ordered)
    assert kinds(recordings) == [("note", "merged")]
    (one,), issues = build_logs(recording, ImportConfig())
    assert [issue.name for issue in issues if issue.severity != "note"] == []
    time = one.start_s + one.log.reading.time
    inner = slice(20, -20)
    np.testing.assert_allclose(
        one.log.reading.angle[inner], np.radians(20 * np.sin(time))[inner], atol=1e-4
    )
    np.testing.assert_allclose(one.log.reading.force[inner, 0], np.sin(time)[inner], atol=1e-3)
    np.testing.assert_allclose(one.log.command.angle, np.radians(20))


FORCE_UNITS = {
    "g": 9.80665e-3,
    "grams": 9.80665e-3,
    "gram-force": 9.80665e-3,
    "kg": 9.80665,
    "kgf": 9.80665,
    "lb": 4.44822,
    "lbs": 4.44822,
    "pounds": 4.44822,
    "oz": 0.278014,
    "ozf": 0.278014,
    "mN": 1e-3,
    "cN": 1e-2,
    "kN": 1e3,
    "0.01 N": 1e-2,
    "0.5g": 0.5 * 9.80665e-3,
}


@pytest.mark.parametrize("form", ["F{} ({})", "F{} [{}]", "F{}_{}", "Force {}, {}"])
@pytest.mark.parametrize(("unit", "newtons"), FORCE_UNITS.items())
def test_units_of_force_in_the_names_are_converted(tmp_path, form, unit, newtons):
    header = [*HEADER[:5], *[f'"{form.format(axis, unit)}"' for axis in "xy"]]
    (recording,) = read(tmp_path / "run.csv", joined([header, *cells(series())]))
    for channel, values in zip(("force_x", "force_y"), series()[5:], strict=True):
        found = recording.tracks[0].channels[channel]
        np.testing.assert_allclose(found, newtons * values, rtol=1e-5, atol=1e-5 * newtons)


@pytest.mark.parametrize("unit", ["0.229rpm", "0.229 rpm", "0.229 rev/min"])
def test_a_multiple_of_a_unit_is_converted(tmp_path, unit):
    header = [*HEADER[:2], f"Profile Velocity [{unit}]", *HEADER[3:]]
    (recording,) = read(tmp_path / "run.csv", joined([header, *cells(series())]))
    np.testing.assert_allclose(
        recording.tracks[0].channels["command_velocity"], 90 * 0.229 * 2 * np.pi / 60, rtol=1e-6
    )


@pytest.mark.parametrize("column", ["Fx [stone]", "Fx (counts)", "Fx_raw", "Fx [deg]", "Fx mV"])
@pytest.mark.parametrize("below", [False, True])
def test_a_unit_that_is_not_known_is_never_taken_for_newtons(tmp_path, column, below):
    header = [*HEADER[:5], column, HEADER[6]]
    table = joined([header, *cells(series())])
    if below:
        unit = column.strip("Fx [](){}_")
        table = joined([NAMES, [*UNITS[:5], unit, "N"], *cells(series())])
        column = f"Fx [{unit}]"
    for options in ({}, {"columns": f"force_x={column}"}):
        with pytest.raises(LogError, match="unknown unit"):
            read(tmp_path / "run.csv", table, **options)
    (recording,) = read(tmp_path / "run.csv", table, force_unit="mN")
    found = recording.tracks[0].channels["force_x"]
    np.testing.assert_allclose(found, series()[5] / 1e3, atol=1e-8)


@pytest.mark.parametrize("column", ["Fx_stone", "Fx stone", "force_x_stone"])
def test_a_word_behind_a_mapped_name_is_not_taken_for_newtons(tmp_path, column):
    table = PLAIN.replace("Fx [N]", column)
    with pytest.raises(LogError, match="unknown unit 'stone'"):
        read(tmp_path / "run.csv", table, columns=f"force_x={column}")
    read(tmp_path / "run.csv", table, columns=f"force_x={column}", force_unit="N")


def test_rostopic_echo_writes_its_time_in_nanoseconds(tmp_path):
    names = ["%time", "field.header.stamp", "field.cmd_angle", "field.cmd_velocity"]
    names += ["field.position", "field.velocity", "field.wrench.force.x", "field.wrench.force.y"]
    time, *motion, x, y = series()
    rows = cells(np.array([*np.radians(motion), x, y]))
    for at, row in zip(time, rows, strict=True):
        row[:0] = [str(1530018381000000000 + round(at * 1e9)), str(round(1e9 * at) + 500)]
    table = joined([names, *rows])
    check_values(read(tmp_path / "run.csv", table)[0])
    mapped = "time=%time,angle=field.position"
    check_values(read(tmp_path / "run.csv", table, columns=mapped)[0])


@pytest.mark.parametrize("bits", [16, 32])
def test_unsigned_integers_get_their_sign(tmp_path, bits):
    ticks = np.round(series()[3] * 4096 / 360).astype(int) - 100
    values = cells(series())
    for row, tick in zip(values, ticks, strict=True):
        row[1] = row[3] = str(tick % 2**bits)
    header = ["time [s]", "goal_position", *HEADER[2:3], "present_position", *HEADER[4:]]
    (recording,) = recordings = read(
        tmp_path / "run.csv",
        joined([header, *values]),
        angles="angle=dynamixel,command_angle=dynamixel",
    )
    np.testing.assert_allclose(
        recording.tracks[0].channels["angle"], ticks * 2 * np.pi / 4096, atol=1e-9
    )
    assert kinds(recordings) == 2 * [("note", "unsigned")]


@pytest.mark.parametrize("unit", ["s", "ms", "us", "ns"])
def test_times_of_parquet_files_are_read(tmp_path, unit):
    table = dict(zip(HEADER, series(), strict=True))
    stamps = pa.array(np.round(1e3 * (1.7e9 + table.pop("time [s]"))).astype(int), pa.int64())
    stamps = stamps.cast(pa.timestamp("ms")).cast(pa.timestamp(unit), safe=False)
    pq.write_table(pa.table({"timestamp": stamps, **table}), tmp_path / "run.parquet")
    (recording,) = read_table(tmp_path / "run.parquet", "run", "train", ImportConfig())
    if unit != "s":
        check_values(recording)


@pytest.mark.parametrize("kind", [pa.string(), pa.large_string()])
def test_texts_of_parquet_files_are_read(tmp_path, kind):
    table = {}
    for name, values in zip(HEADER, series(), strict=True):
        table[name] = pa.array([f"{value:.5f}" for value in values], kind)
    pq.write_table(pa.table(table), tmp_path / "run.parquet")
    (recording,) = read_table(tmp_path / "run.parquet", "run", "train", ImportConfig())
    check_values(recording)


@pytest.mark.parametrize("size", [2, -1])
def test_columns_of_lists_are_split_and_mapped_by_their_index(tmp_path, size):
    time, *motion, x, y = series()
    motion = np.radians(motion)

    def pairs(first, second):
        return pa.array(np.stack([first, second], axis=1).tolist(), pa.list_(pa.float64(), size))

    table = pa.table(
        {
            "timestamp": time,
            "action": pairs(motion[0], motion[1]),
            "observation.state": pairs(motion[2], motion[3]),
            "observation.wrench": pairs(x, y),
        }
    )
    path = tmp_path / "run.parquet"
    pq.write_table(table, path)
    with pytest.raises(LogError, match=r"action\[0\]"):
        read_table(path, "run", "train", ImportConfig())
    mapped = (
        "command_angle=action[0],command_velocity=action[1],angle=observation.state[0],"
        "velocity=observation.state[1],force_x=observation.wrench[0],force_y=observation.wrench[1]"
    )
    (recording,) = read_table(path, "run", "train", ImportConfig.build({"columns": mapped}))
    check_values(recording)


def test_a_clock_without_digits_is_replaced_by_a_rate(tmp_path):
    values = cells(series())
    for row in values:
        row[0] = "1.7e+09"
    table = joined([HEADER, *values])
    with pytest.raises(LogError, match="--rate 100 --columns time=-"):
        build_logs(read(tmp_path / "run.csv", table)[0], ImportConfig())
    check_values(read(tmp_path / "run.csv", table, rate_hz=100, columns="time=-")[0])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("notes.txt", "Run 1: fin B, 12 mm silicone.\nWater 19 C.\n"),
        ("summary.csv", "run,mean thrust [N],comment\n1,0.42,ok\n"),
        ("gains.csv", "name,p,i,d,limit\nyaw,1,2,3,4\n"),
        ("empty.csv", ""),
        ("started.csv", joined([HEADER])),
    ],
)
def test_a_file_that_is_no_log_is_named_and_costs_no_other(tmp_path, name, content):
    (tmp_path / "run.csv").write_text(PLAIN)
    with pytest.raises(NotALogError):
        read(tmp_path / name, content)
    opened = open_logs(tmp_path)
    assert [one.name for one in opened.logs] == ["run.csv"]
    (issue,) = [one for one in opened.inspection.issues if one.name == "not a log"]
    assert (issue.severity, issue.log) == ("warning", name)


def test_a_log_that_cannot_be_read_is_an_error_and_costs_no_other(tmp_path):
    (tmp_path / "run.csv").write_text(PLAIN)
    (tmp_path / "stone.csv").write_text(PLAIN.replace("Fx [N]", "Fx [stone]"))
    (issue,) = [one for one in open_logs(tmp_path).inspection.issues if one.name == "unreadable"]
    assert (issue.severity, issue.log) == ("error", "stone.csv")
    (tmp_path / "run.csv").unlink()
    with pytest.raises(LogError, match="stone"):
        open_logs(tmp_path)


@pytest.mark.parametrize("again", ["sep=,\n" + UNITS_BELOW, UNITS_BELOW])
def test_a_header_with_units_that_comes_again_starts_a_log(tmp_path, again):
    recordings = read(tmp_path / "run.csv", UNITS_BELOW + again)
    assert kinds(recordings) == []
    for recording in recordings:
        check_values(recording)
    assert len(recordings) == 2


@pytest.mark.parametrize(
    ("delimiter", "form"), [(";", "{:,.2f}"), (",", '"{:,.2f}"'), (";", "{:,.0f}")]
)
def test_separators_of_thousands_and_units_in_cells_are_refused(tmp_path, delimiter, form):
    rows = cells(series())
    for row in rows:
        row[5] = form.format(2000 * float(row[5]))
    with pytest.raises(LogError, match=r"column 'Fx \[N\]': .* not plain numbers, the first"):
        read(tmp_path / "run.csv", joined([HEADER, *rows], delimiter))


def test_decimal_commas_with_three_decimals_are_no_thousands(tmp_path):
    rows = [[f"{float(cell):.3f}".replace(".", ",") for cell in row] for row in cells(series())]
    (recording,) = read(tmp_path / "run.csv", joined([HEADER, *rows], ";"))
    np.testing.assert_allclose(recording.tracks[0].channels["force_y"], series()[6], atol=1e-3)


def test_parquet_times_of_day_are_read(tmp_path):
    time = pa.array(np.arange(ROWS) * 10, pa.int32()).cast(pa.time32("ms"))
    table = pa.table([time, *series()[1:]], names=["time", *HEADER[1:]])
    pq.write_table(table, tmp_path / "run.parquet")
    (recording,) = read_table(tmp_path / "run.parquet", "run", "train", ImportConfig())
    check_values(recording)


def test_a_clock_on_a_grid_that_is_not_its_rate_is_a_warning(tmp_path):
    values = cells(series())
    for index, row in enumerate(values):
        row[0] = f"{np.float32(70_000 + index / 100):.5f}"
    recordings = read(tmp_path / "run.csv", joined([HEADER, *values]))
    _, issues = build_logs(recordings[0], ImportConfig())
    assert "coarse clock" in [one.name for one in issues]


def test_the_unit_of_a_header_is_the_one_that_a_rate_is_judged_by(tmp_path):
    content = PLAIN.replace("time [s]", "time [ms]")
    (recording,) = read(tmp_path / "run.csv", content)
    with pytest.raises(LogError, match="if the time is in s, use --time-unit s"):
        build_logs(recording, ImportConfig())
