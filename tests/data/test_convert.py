import re

import numpy as np
import pytest

from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.core.log_channels import KNOWN_CHANNELS, LOAD_CHANNELS
from softfin.data.convert import convert, encode_bag
from softfin.data.importing.importing import ImportConfig
from softfin.data.recordings import open_logs
from softfin.storage.bag.messages import COMMAND, CURRENT, JOINT, WRENCH
from softfin.storage.log_file import read_log, write_log
from tests.data.faulty import cut, tank_logs
from tests.data.recorded import by_mcap_ros2, by_rosbags, record


@pytest.fixture(scope="module")
def log():
    return cut(tank_logs()[0], 0, 1000)


def check_equal(found, log, tolerance_s=1e-9):
    np.testing.assert_allclose(found.reading.time, log.reading.time, atol=tolerance_s, rtol=0)
    for one, other in zip(
        (*found.command, *found.reading[1:]), (*log.command, *log.reading[1:]), strict=True
    ):
        assert one.dtype == np.float32
        np.testing.assert_array_equal(one, np.asarray(other, np.float32))


@pytest.mark.parametrize("start", [0.0, 0.01, 1_700_000_000.123456])
def test_a_log_comes_back_from_a_bag_as_it_was(tmp_path, log, start):
    time = start + np.arange(len(log.reading.time)) / 100
    log = log._replace(reading=log.reading._replace(time=time))
    write_log(tmp_path / "one.parquet", log)
    there = convert(tmp_path / "one.parquet", tmp_path / "one.mcap")
    assert there["rows"] == 1000
    assert by_rosbags(tmp_path / "one.mcap") == by_mcap_ros2(tmp_path / "one.mcap")
    back = convert(tmp_path / "one.mcap", tmp_path / "back.parquet")
    assert back["files"] == [str(tmp_path / "back.parquet")]
    check_equal(read_log(tmp_path / "back.parquet"), log, tolerance_s=1e-6)
    severities = {issue.severity for issue in open_logs(tmp_path / "one.mcap").inspection.issues}
    assert severities == {"note"}


def test_a_recorded_bag_becomes_a_log(tmp_path):
    path = record(tmp_path / "run.mcap", rows=400)
    convert(path, tmp_path / "run.parquet")
    log = read_log(tmp_path / "run.parquet")
    assert len(log.reading.time) == 400
    np.testing.assert_array_equal(log.reading.angle, np.float32(0.001 * np.arange(400)))
    np.testing.assert_array_equal(log.command.velocity, 2.0)
    levels = {
        "force_z_n": 0.1,
        "torque_x_nm": 0.2,
        "torque_y_nm": 0.3,
        "torque_nm": 0.4,
        "current_a": 0.25,
    }
    assert set(log.channels) == set(levels)
    for name, level in levels.items():
        np.testing.assert_array_equal(log.channels[name], np.float32(level))
    first = by_rosbags(path)[JOINT][0][0]
    assert log.reading.time[0] == pytest.approx(first / 1e9, abs=1e-6)


def test_channels_come_back_from_a_bag_as_they_were(tmp_path, log):
    random = np.random.default_rng(0).normal(size=(8, 1000)).astype(np.float32)
    names = (*KNOWN_CHANNELS, "temperature_c", "flow rate [l/s]")
    channels = dict(zip(names, random, strict=True))
    write_log(tmp_path / "one.parquet", log._replace(channels=channels))
    convert(tmp_path / "one.parquet", tmp_path / "one.mcap")
    found = by_rosbags(tmp_path / "one.mcap")
    assert found == by_mcap_ros2(tmp_path / "one.mcap")
    assert found[CURRENT][10][1] == channels["current_a"][10]
    np.testing.assert_array_equal(
        [row[5:9] for row in found[WRENCH]],
        np.stack([channels[name] for name in LOAD_CHANNELS], axis=1),
    )
    convert(tmp_path / "one.mcap", tmp_path / "back.parquet")
    back = read_log(tmp_path / "back.parquet")
    check_equal(back, log._replace(reading=back.reading._replace(force=log.reading.force)), 1e-6)
    channels["flow_rate__l_s_"] = channels.pop("flow rate [l/s]")
    assert set(back.channels) == set(channels)
    for name, values in back.channels.items():
        np.testing.assert_array_equal(values, channels[name])


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (("temp a", "temp-a"), "channels 'temp a' and 'temp-a' would both be temp_a in a bag;"),
        (("current_a", "current a"), "channels 'current_a' and 'current a' would both be"),
        (("torque nm", "torque_nm"), "channels 'torque nm' and 'torque_nm' would both be"),
        (("time",), "channel 'time': in a bag, every log has time; rename it"),
        (("angle",), "channel 'angle': in a bag"),
        (("angle-rad",), "channel 'angle-rad': in a bag, every log has angle_rad"),
    ],
)
def test_channels_that_a_bag_would_lose_are_refused(log, names, words):
    with pytest.raises(LogError, match=re.escape(f"one: {words}")):
        encode_bag(log._replace(channels=dict.fromkeys(names, np.zeros(1000))), "one")


def test_a_log_with_some_loads_has_no_others_after_a_bag(tmp_path, log):
    torque = np.linspace(-1, 1, 1000, dtype=np.float32)
    (tmp_path / "one.mcap").write_bytes(
        encode_bag(log._replace(channels={"torque_nm": torque}), "one")
    )
    convert(tmp_path / "one.mcap", tmp_path / "back.parquet")
    channels = read_log(tmp_path / "back.parquet").channels
    assert list(channels) == ["torque_nm"]
    np.testing.assert_array_equal(channels["torque_nm"], torque)


def test_several_logs_become_several_files(tmp_path, log):
    whole = cut(log, 0, 900)
    time = np.asarray(whole.reading.time) + np.where(np.arange(900) < 400, 0.0, 3.0)
    bag = encode_bag(whole._replace(reading=whole.reading._replace(time=time)), "gap")
    (tmp_path / "gap.mcap").write_bytes(bag)
    result = convert(tmp_path / "gap.mcap", tmp_path / "piece.parquet")
    assert [len(read_log(tmp_path / f"piece-{n}.parquet").reading.time) for n in (1, 2)] == [
        400,
        500,
    ]
    assert result["counts"]["warning"] == 1
    assert read_log(tmp_path / "piece-2.parquet").reading.time[0] == pytest.approx(
        time[400], abs=1e-6
    )


def test_what_is_at_out_stays_unless_it_is_said(tmp_path, log):
    write_log(tmp_path / "one.parquet", log)
    convert(tmp_path / "one.parquet", tmp_path / "one.mcap")
    with pytest.raises(ArtifactError, match="already exists"):
        convert(tmp_path / "one.parquet", tmp_path / "one.mcap")
    convert(tmp_path / "one.parquet", tmp_path / "one.mcap", overwrite=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["one.mcap", "one.parquet"]


def test_another_kind_than_two_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r"must end in \.mcap or \.parquet"):
        convert(tmp_path / "one.parquet", tmp_path / "one.csv")


def test_errors_stop_it_unless_they_are_accepted(tmp_path, log):
    degrees = log._replace(reading=log.reading._replace(angle=np.degrees(log.reading.angle)))
    (tmp_path / "one.mcap").write_bytes(encode_bag(degrees, "one"))
    with pytest.raises(LogError, match="degrees"):
        convert(tmp_path / "one.mcap", tmp_path / "one.parquet")
    convert(tmp_path / "one.mcap", tmp_path / "one.parquet", ignore_errors=True)
    convert(
        tmp_path / "one.mcap", tmp_path / "two.parquet", ImportConfig.build({"angles": "angle=deg"})
    )
    np.testing.assert_allclose(
        read_log(tmp_path / "two.parquet").reading.angle, log.reading.angle, rtol=1e-6
    )


def test_a_time_before_zero_has_no_stamp(log):
    early = log._replace(reading=log.reading._replace(time=np.asarray(log.reading.time) - 5.0))
    with pytest.raises(LogError, match="add a constant"):
        encode_bag(early, "one")


def test_a_log_becomes_three_topics(tmp_path, log):
    (tmp_path / "one.mcap").write_bytes(encode_bag(log, "one"))
    found = by_rosbags(tmp_path / "one.mcap")
    assert {topic: len(rows) for topic, rows in found.items()} == {
        COMMAND: 1000,
        JOINT: 1000,
        WRENCH: 1000,
    }
    assert found[WRENCH][10][3:5] == tuple(
        map(float, np.asarray(log.reading.force[10], np.float64))
    )
