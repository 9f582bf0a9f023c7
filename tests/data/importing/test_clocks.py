import re

import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.data.importing.clocks import Recording, Track, build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.storage.log_file import encode_log
from tests.data.faulty import tank_logs, to_columns

NAMES = ("command_angle", "command_velocity", "angle", "velocity", "force_x", "force_y")


def track(rows=1000, **changes) -> Track:
    columns = list(to_columns(tank_logs()[0]).values())
    channels = {name: values[:rows].copy() for name, values in zip(NAMES, columns[1:], strict=True)}
    return Track(columns[0][:rows].copy(), channels)


def valid_rows(one: Track, keep) -> Track:
    return Track(one.time[keep], {name: values[keep] for name, values in one.channels.items()})


def logs(*tracks: Track, **options):
    return build_logs(Recording("run", "train", tracks), ImportConfig.build(options))


def kinds(issues) -> list[str]:
    return [one.name for one in issues]


def test_a_steady_100_hz_passes_bit_by_bit_but_for_where_its_time_begins():
    (one,), issues = logs(track(3000))
    original = tank_logs()[0]
    assert not issues
    np.testing.assert_array_equal(one.log.command.angle, original.command.angle[:3000])
    np.testing.assert_array_equal(one.log.reading.force, original.reading.force[:3000])
    np.testing.assert_allclose(one.log.reading.time, np.arange(3000) / 100, atol=1e-9)
    assert one.start_s == original.reading.time[0]


@pytest.mark.parametrize("hz", [100, 1000])
def test_a_unix_clock_loses_no_row_and_begins_at_0(hz):
    time = 1.7e9 + np.arange(0, 10, 1 / hz)
    (unix,), _ = logs(Track(time, {name: np.sin(time - 1.7e9 + i) for i, name in enumerate(NAMES)}))
    np.testing.assert_allclose(unix.log.reading.time, np.arange(1000) / 100, atol=1e-6)
    assert unix.start_s == 1.7e9


def test_a_unix_clock_that_starts_anew_begins_at_0_both_times():
    one = track(1200)
    one.time[:] += 1.7e9
    one.time[500:] -= 3600
    pieces, _ = logs(one)
    assert [len(piece.log.reading.time) for piece in pieces] == [500, 700]
    assert [piece.log.reading.time[0] for piece in pieces] == [0, 0]
    assert pieces[0].start_s - pieces[1].start_s == pytest.approx(3595)


@pytest.mark.parametrize("gap_s", [0.3, 1e9])
def test_nothing_of_a_fast_source_gets_across_a_gap_however_long(gap_s):
    """A clock that was set in between, as by NTP, would be 8 TB of samples."""
    time = np.arange(0, 6, 0.001)
    time[3000:] += gap_s
    level = np.repeat([1.0, 5.0], 3000)
    before, after = logs(Track(time, dict.fromkeys(NAMES, level)))[0]
    assert [len(piece.log.reading.time) for piece in (before, after)] == [300, 300]
    for piece, value in ((before, 1), (after, 5)):
        np.testing.assert_allclose(piece.log.reading.force, value, rtol=1e-6)
        np.testing.assert_array_equal(piece.log.command.angle, value)


def test_jitter_of_less_than_half_a_sample_passes_too():
    one = track()
    jitter = np.random.default_rng(0).uniform(-0.002, 0.002, 1000)
    (log,), issues = logs(one._replace(time=one.time + jitter))
    assert not issues
    np.testing.assert_array_equal(log.log.reading.angle, one.channels["angle"].astype(np.float32))


@pytest.mark.parametrize("hz", [50, 100, 1000])
@pytest.mark.parametrize(("start", "end"), [(-np.pi, np.pi), (0, 2 * np.pi)])
def test_an_encoder_that_wraps_is_an_error_and_unwrapped_if_that_is_ignored(hz, start, end):
    time = np.arange(0, 10, 1 / hz)
    angle = (3.5 if start else 0.4) * np.sin(2 * time)
    wrapped = (angle - start) % (end - start) + start
    channels = {name: np.cos(time + i) for i, name in enumerate(NAMES) if name != "velocity"}
    (one,), issues = logs(Track(time, channels | {"angle": wrapped}))
    issue = next(one for one in issues if one.name == "wraps")
    assert (issue.severity, issue.column) == ("error", "angle")
    assert abs(wrapped[issue.row] - wrapped[issue.row - 1]) > 6
    assert "set the encoder zero at the rest position of the fin" in issue.fix
    expected = np.interp(one.log.reading.time, time, angle)
    np.testing.assert_allclose(one.log.reading.angle, expected, atol=0.02)
    assert np.abs(one.log.reading.velocity).max() < 8


def test_a_lost_count_and_degrees_are_no_wrapped_encoder():
    one = track()
    one.channels["angle"][500:] += 2.5
    assert "wraps" not in kinds(logs(one)[1])
    degrees = track()
    degrees.channels["angle"] = 5 * np.degrees(degrees.channels["angle"])
    assert np.abs(np.diff(degrees.channels["angle"])).max() > 6
    assert "wraps" not in kinds(logs(degrees)[1])


def test_a_long_gap_splits_and_is_never_bridged():
    keep = np.r_[0:400, 430:1000]
    pieces, issues = logs(valid_rows(track(), keep))
    assert [len(piece.log.reading.time) for piece in pieces] == [400, 570]
    assert [piece.name for piece in pieces] == ["run, piece 1 of 2", "run, piece 2 of 2"]
    assert pieces[1].log.reading.time[0] == pytest.approx(4.30)
    (gap,) = issues
    assert (gap.severity, gap.name, gap.row) == ("warning", "gap", 399)
    assert "0.310 s after 3.99 s" in gap.message
    for piece in pieces:
        encode_log(piece.log, "a piece is a whole log")


def test_a_short_gap_is_bridged_by_interpolation():
    one = track()
    (log,), issues = logs(valid_rows(one, np.r_[0:400, 403:1000]))
    assert len(log.log.reading.time) == 1000
    assert not issues
    angle = one.channels["angle"]
    np.testing.assert_allclose(
        log.log.reading.angle[401], angle[399] + (angle[403] - angle[399]) / 2, atol=1e-6
    )
    np.testing.assert_allclose(log.log.reading.angle[600:], angle[600:], atol=1e-6)
    # The last command before the gap holds until the next.
    assert log.log.command.angle[402] == one.channels["command_angle"].astype(np.float32)[399]


def test_pieces_that_are_too_short_are_left_out_and_counted():
    pieces, issues = logs(valid_rows(track(), np.r_[0:400, 430:500, 530:1000]))
    assert [len(piece.log.reading.time) for piece in pieces] == [400, 470]
    assert "1 piece between gaps, shorter than 2 s, dropped: 0.69 s" in issues[-1].message
    assert len(logs(valid_rows(track(), np.r_[0:400, 430:500, 530:1000]), shortest_s=0.5)[0]) == 3


@pytest.mark.parametrize(("num_missing", "severity"), [(20, "warning"), (60, "error")])
def test_rows_without_a_value_are_dropped_and_split_where_there_are_many(num_missing, severity):
    one = track()
    one.channels["force_x"][300 : 300 + num_missing] = np.nan
    one.channels["angle"][700] = np.inf
    pieces, issues = logs(one)
    assert [len(piece.log.reading.time) for piece in pieces] == [300, 700 - num_missing]
    found = [one for one in issues if one.name == "not a number"]
    assert [(one.severity, one.column, one.row) for one in found] == [
        ("warning", "angle", 700),
        (severity, "force_x", 300),
    ]
    assert all(np.isfinite(piece.log.reading.force).all() for piece in pieces)


def test_a_few_repeated_and_backward_times_are_left_out_with_a_warning():
    one = track()
    one.time[500] = one.time[499]
    one.time[600] -= 0.025
    (log,), issues = logs(one)
    assert len(log.log.reading.time) == 1000
    (found, *_) = issues
    assert (found.severity, found.name, found.row) == ("warning", "repeated time", 500)


@pytest.mark.parametrize(("rows_per_time", "hz"), [(2, 200), (5, 500)])
def test_a_clock_coarser_than_the_rows_is_an_error_that_names_the_rate(rows_per_time, hz):
    time = np.arange(3000) // rows_per_time / 100
    _, issues = logs(Track(time, {name: np.sin(time + i) for i, name in enumerate(NAMES)}))
    (error,) = issues
    assert (error.severity, error.name, error.column) == ("error", "coarse clock", "time")
    (rate,) = re.findall(r"--rate ([\d.]+) ", error.fix)
    assert float(rate) == pytest.approx(hz, rel=0.01)


@pytest.mark.parametrize("kind", [np.float32, lambda time: np.array([f"{t:.6g}" for t in time])])
def test_a_clock_that_is_rounded_away_is_refused_with_the_option_for_a_rate(kind):
    one = track()
    with pytest.raises(LogError, match="--rate 100 --columns time=-"):
        logs(one._replace(time=kind(1.7e9 + one.time).astype(float)))


def test_tracks_that_all_start_anew_begin_another_log():
    one = track(1200)
    one.time[500:] -= one.time[500]
    motion = {name: one.channels.pop(name) for name in NAMES[:4]}
    pieces, _ = logs(Track(one.time, motion), one)
    assert [len(piece.log.reading.time) for piece in pieces] == [500, 700]


def test_a_clock_that_starts_anew_begins_another_log():
    one = track(1200)
    one.time[500:] -= one.time[500]
    pieces, issues = logs(one)
    assert [piece.name for piece in pieces] == ["run rows 0..499", "run rows 500..1199"]
    assert [len(piece.log.reading.time) for piece in pieces] == [500, 700]
    assert not issues


def test_a_fast_source_is_resampled_and_that_is_noted():
    time = np.arange(0, 10, 0.001)
    channels = {name: np.sin(time + i) for i, name in enumerate(NAMES)}
    (log,), issues = logs(Track(time, channels))
    assert kinds(issues) == ["resampled"]
    assert "sampled faster than 100 Hz" in issues[0].message
    np.testing.assert_allclose(log.log.reading.time[:3], [0, 0.01, 0.02])
    np.testing.assert_allclose(
        log.log.reading.force[20:-20, 0], np.sin(log.log.reading.time[20:-20] + 4), atol=1e-3
    )


def test_a_slow_source_is_a_warning():
    (log,), issues = logs(valid_rows(track(), slice(0, None, 2)))
    assert [(one.severity, one.name) for one in issues] == [("warning", "slow rate")]
    assert len(log.log.reading.time) == 999


def test_the_rate_of_times_in_whole_milliseconds_is_their_mean():
    time = np.round(np.arange(0, 20, 1 / 80), 3)
    channels = {name: np.sin(time + i) for i, name in enumerate(NAMES)}
    _, issues = logs(Track(time, channels))
    assert "sampled at 80.0 Hz" in issues[0].message


def test_missing_rows_do_not_make_a_source_slow():
    whole = track()
    rows = np.arange(len(whole.time))
    _, issues = logs(valid_rows(whole, rows % 20 != 7))
    assert "slow rate" not in kinds(issues)


@pytest.mark.parametrize(("factor", "unit"), [(1e3, "ms"), (1e6, "us"), (1e9, "ns")])
def test_a_clock_in_another_unit_is_refused_with_the_option(factor, unit):
    one = track()
    with pytest.raises(LogError, match=f"--time-unit {unit}"):
        logs(one._replace(time=one.time * factor))


def test_a_clock_in_no_plausible_unit_is_refused_without_that_option():
    one = track()
    with pytest.raises(LogError, match="Hz") as error:
        logs(one._replace(time=one.time * 1e-9))
    assert "--time-unit" not in str(error.value)


def test_a_velocity_that_is_not_there_is_the_angles_central_difference():
    one = track()
    del one.channels["velocity"]
    (log,), _ = logs(one)
    angle = one.channels["angle"]
    np.testing.assert_allclose(
        log.log.reading.velocity[100], (angle[101] - angle[99]) / 0.02, rtol=1e-4
    )


def test_three_clocks_meet_where_all_have_begun_and_commands_hold():
    time = np.arange(0, 10, 0.01)
    joint = Track(time + 0.003, {"angle": time, "velocity": np.ones_like(time)})
    fast = np.arange(0.5, 9, 0.001)
    wrench = Track(fast, {"force_x": fast, "force_y": fast})
    steps = {"command_angle": np.array([1.0, 2, 3]), "command_velocity": np.ones(3)}
    command = Track(np.array([1.0, 2.0, 5.004]), steps)
    (log,), _ = logs(joint, wrench, command)
    reading = log.log.reading
    time = log.start_s + log.log.reading.time
    assert log.start_s == 0.003
    assert time[0] == pytest.approx(1.0)
    assert time[-1] == pytest.approx(9.0, abs=0.011)
    np.testing.assert_allclose(reading.angle, time - 0.003, atol=1e-5)
    np.testing.assert_allclose(reading.force[20:-20, 0], time[20:-20], atol=1e-4)
    assert set(log.log.command.angle) == {1, 2, 3}
    # Issued at 5.004 s: the row of 5.00 s is over, that of 5.01 s has it.
    assert log.log.command.angle[400] == 2
    assert log.log.command.angle[401] == 3


def test_clocks_that_never_meet_are_refused():
    time = np.arange(0, 10, 0.01)
    joint = Track(time, {"angle": time})
    wrench = Track(time + 100, {"force_x": time, "force_y": time})
    with pytest.raises(LogError, match="no time in common: angle"):
        logs(joint, wrench, Track(time, {"command_angle": time, "command_velocity": time}))


@pytest.mark.parametrize(
    ("option", "channel"), [("force_lag_ms", "force_x"), ("command_lag_ms", "command_angle")]
)
def test_a_lag_that_is_given_is_taken_out(option, channel):
    late = track()
    names = [name for name in NAMES if name.split("_")[0] == channel.split("_")[0]]
    for name in names:
        late.channels[name][5:] = late.channels[name][:-5].copy()
    (log,), _ = logs(late, **{option: 50})
    (plain,), _ = logs(track())

    def series(one):
        return one.reading.force[:, 0] if channel == "force_x" else one.command.angle

    row = int(np.flatnonzero(np.isclose(plain.log.reading.time, log.log.reading.time[0]))[0])
    count = min(len(log.log.reading.time), 900)
    np.testing.assert_allclose(
        series(log.log)[:count], series(plain.log)[row : row + count], atol=1e-5
    )
    np.testing.assert_allclose(
        log.log.reading.angle[:count], plain.log.reading.angle[row : row + count], atol=1e-5
    )


def test_too_few_rows_are_refused():
    with pytest.raises(LogError, match="only 1 row with"):
        logs(track(1))


def with_channel(one: Track, **channels) -> Track:
    return Track(one.time, one.channels | channels)


def test_further_channels_of_a_steady_clock_pass_bit_by_bit():
    torque = np.random.default_rng(0).normal(size=1000).astype(np.float32)
    (one,), issues = logs(with_channel(track(), torque_nm=torque.astype(float)))
    assert not issues
    assert one.log.channels["torque_nm"].dtype == np.float32
    np.testing.assert_array_equal(one.log.channels["torque_nm"], torque)


def test_missing_values_of_a_further_channel_cost_no_row():
    ramp = np.arange(1000) / 100
    holes = np.where(np.arange(1000) % 2, ramp, np.nan)
    holes[300:400] = np.nan
    (one,), issues = logs(with_channel(track(), temperature_c=holes))
    (plain,), _ = logs(track())
    np.testing.assert_array_equal(one.log.reading.force, plain.log.reading.force)
    np.testing.assert_allclose(one.log.channels["temperature_c"][1:], ramp[1:], atol=1e-5)
    (issue,) = issues
    assert (issue.severity, issue.name) == ("warning", "channel gap")
    assert issue.column == "temperature_c"
    assert "no values for up to 1.02 s" in issue.message


def test_a_channel_without_values_is_left_out_with_a_warning():
    (one,), issues = logs(with_channel(track(), current_a=np.full(1000, np.nan)))
    assert one.log.channels == {}
    assert kinds(issues) == ["channel gap"]


def test_further_channels_are_filtered_resampled_and_split_like_the_log():
    time = np.arange(0, 10, 0.001)
    channels = {name: np.sin(time + i) for i, name in enumerate(NAMES)}
    noise = np.sin(2 * np.pi * 200 * time)
    fast = Track(time, channels | {"torque_nm": np.sin(3 * time) + noise})
    keep = (time < 4) | (time > 5)
    pieces, _ = logs(valid_rows(fast, keep))
    assert len(pieces) == 2
    for piece in pieces:
        # At the ends, the filter has fewer samples.
        found = piece.log.channels["torque_nm"][5:-5]
        np.testing.assert_allclose(found, np.sin(3 * piece.log.reading.time[5:-5]), atol=0.01)


def test_a_clock_of_its_own_is_taken_for_a_further_channel():
    slow = np.arange(-0.5, 11, 0.04)
    (one,), issues = logs(track(), Track(slow, {"current_a": 2 * slow}))
    assert kinds(issues) == []
    time = one.start_s + one.log.reading.time
    np.testing.assert_allclose(one.log.channels["current_a"], 2 * time, atol=1e-5)


def test_torque_is_shifted_with_the_force():
    ramp = np.arange(1000) / 100
    (one,), _ = logs(
        with_channel(track(), torque_nm=ramp, current_a=ramp), force_lag_ms=50, gap_s=0.1
    )
    torque, current = one.log.channels["torque_nm"], one.log.channels["current_a"]
    np.testing.assert_allclose(torque[10:900] - current[10:900], 0.05, atol=1e-4)


@pytest.mark.parametrize(("late_s", "names"), [(0.1, []), (0.5, ["unused rows"])])
def test_what_precedes_the_first_command_is_left_out_with_a_note(late_s, names):
    whole = track()
    commands = {name: whole.channels[name] for name in NAMES[:2]}
    readings = {name: whole.channels[name] for name in NAMES[2:]}
    late = Track(whole.time, commands).take(whole.time - whole.time[0] >= late_s - 1e-6)
    (one,), issues = logs(Track(whole.time, readings), late)
    assert kinds(issues) == names
    assert len(one.log.reading.time) == 1000 - round(100 * late_s)
