import shutil

import numpy as np
import pytest
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from softfin.core.errors import LogError
from softfin.data.importing.clocks import build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.rosbag import read_bag
from softfin.storage.bag.zero import zero_event
from tests.data.bags import START_S, TYPES, array, joint, text, topics_of, wrench, write_bag
from tests.data.faulty import tank_logs, to_columns


@pytest.fixture(scope="module")
def columns():
    return to_columns(tank_logs()[0])


@pytest.fixture(scope="module")
def bag(tmp_path_factory, columns):
    path = tmp_path_factory.mktemp("bags") / "run"
    write_bag(path, topics_of(columns))
    return path


def opened(path, **options):
    config = ImportConfig.build(options)
    recording = read_bag(path, path.name, "train", config)
    logs, issues = build_logs(recording, config)
    return logs, issues


def check(one, columns):
    log = one.log
    reading = one.log.reading
    assert reading.time[0] < 0.011
    np.testing.assert_allclose(
        one.start_s + reading.time - START_S, columns["time_s"][: len(reading.time)], atol=1e-5
    )
    np.testing.assert_allclose(reading.angle, columns["angle_rad"][: len(reading.time)], atol=1e-5)
    np.testing.assert_array_equal(
        log.command.angle, columns["command_angle_rad"][: len(reading.time)].astype(np.float32)
    )
    assert np.corrcoef(reading.force[:, 1], columns["force_y_n"][: len(reading.time)])[0, 1] > 0.995


@pytest.mark.parametrize("storage", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_a_bag_comes_back_as_the_log_that_it_was(tmp_path, columns, storage):
    write_bag(tmp_path / "run", topics_of(columns), storage, delay_s=0.123)
    (one,), issues = opened(tmp_path / "run")
    assert len(one.log.reading.time) == 999
    check(one, columns)
    assert [issue.name for issue in issues] == ["resampled"]


def test_a_lone_mcap_file_is_a_bag(tmp_path, bag, columns):
    (file,) = bag.glob("*.mcap")
    shutil.copy(file, tmp_path / "lone.mcap")
    (one,), _ = opened(tmp_path / "lone.mcap")
    check(one, columns)


def test_without_stamps_the_time_of_logging_counts_and_is_told(tmp_path, columns):
    write_bag(tmp_path / "run", topics_of(columns, stamped=False), delay_s=0.25)
    (one,), issues = opened(tmp_path / "run")
    assert one.start_s + one.log.reading.time[0] - START_S == pytest.approx(0.26, abs=1e-5)
    assert [(f.severity, f.name) for f in issues].count(("warning", "no stamps")) == 3


def test_a_command_may_be_an_array_of_angle_and_velocity(tmp_path, columns):
    topics = topics_of(columns)
    topics["/fin/command"] = [
        (time, array(m.position[0], m.velocity[0])) for time, m in topics["/fin/command"]
    ]
    write_bag(tmp_path / "run", topics)
    (one,), _ = opened(tmp_path / "run")
    check(one, columns)


def test_topics_are_named_and_one_joint_of_several(tmp_path, columns):
    plain = topics_of(columns)
    several = [
        (time, joint(time, one.position[0], one.velocity[0], ("tail", "fin")))
        for time, one in plain["/fin/joint_states"]
    ]
    topics = {"/a": several, "/b": plain["/fin/command"], "/c": plain["/fin/wrench"]}
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match="tail, fin"):
        opened(tmp_path / "run", topics="joint=/a,command=/b,wrench=/c")
    (one,), _ = opened(tmp_path / "run", topics="joint=/a:fin,command=/b,wrench=/c")
    np.testing.assert_allclose(one.log.reading.angle, columns["angle_rad"][:999] + 100, atol=1e-4)


def test_a_joint_without_velocities_has_its_derived(tmp_path, columns):
    topics = topics_of(columns)
    topics["/fin/joint_states"] = [
        (t, joint(t, m.position[0], None)) for t, m in topics["/fin/joint_states"]
    ]
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    assert "velocity derived" in [issue.name for issue in issues]
    angle = one.log.reading.angle.astype(float)
    np.testing.assert_allclose(
        one.log.reading.velocity[5:-5], (angle[6:-4] - angle[4:-6]) / 0.02, atol=1e-3
    )


def test_a_velocity_that_is_not_to_be_read_is_derived(bag):
    (one,), issues = opened(bag, columns="velocity=-")
    assert "velocity derived" in [issue.name for issue in issues]
    np.testing.assert_allclose(
        one.log.reading.velocity, np.gradient(one.log.reading.angle, 0.01), atol=1e-3
    )


def test_commands_without_velocities_take_the_one_that_is_told(tmp_path, columns):
    topics = topics_of(columns)
    topics["/fin/command"] = [(t, joint(t, m.position[0], None)) for t, m in topics["/fin/command"]]
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match=r"/fin/command: .* --velocity"):
        opened(tmp_path / "run")
    (one,), issues = opened(tmp_path / "run", velocity_rad_s=2.5, angles="deg")
    assert set(one.log.command.velocity.tolist()) == {2.5}
    assert "no velocity: 2.5 rad/s everywhere, from --velocity" in issues[0].message


def test_the_force_at_rest_that_a_session_measured_is_subtracted_from_then_to_the_next(
    tmp_path, columns
):
    topics = topics_of(columns, force_hz=100)
    write_bag(tmp_path / "raw", topics)
    measured = [(1.0, zero_event((0.5, -0.25))), (6.0, zero_event((2.0, 0.0)))]
    events = [(0.02, "active"), *measured, (7.0, "inactive")]
    topics["/fin/events"] = [(time, text(words)) for time, words in events]
    write_bag(tmp_path / "run", topics)
    (raw,), before = opened(tmp_path / "raw", force="y,-x")
    (one,), issues = opened(tmp_path / "run", force="y,-x")
    assert "zeroed" not in [issue.name for issue in before]
    (note,) = [issue for issue in issues if issue.name == "zeroed"]
    assert "(2 measurements)" in note.message
    # Before the first measurement its zero holds, too: the sensor is the same.
    offset = raw.log.reading.force - one.log.reading.force
    time = raw.start_s + raw.log.reading.time - START_S
    early = offset[time < 5.98]
    late = offset[time > 6.02]
    np.testing.assert_allclose(early, np.tile([-0.25, -0.5], (len(early), 1)), atol=1e-5)
    np.testing.assert_allclose(late, np.tile([0.0, -2.0], (len(late), 1)), atol=1e-5)


def test_a_force_of_another_topic_keeps_its_own_zero(tmp_path, columns):
    topics = topics_of(columns)
    topics["/other"] = topics.pop("/fin/wrench")
    write_bag(tmp_path / "run", topics | {"/fin/events": [(1.0, text(zero_event((0.5, -0.25))))]})
    (one,), _ = opened(tmp_path / "run", topics="wrench=/other")
    check(one, columns)
    assert abs(one.log.reading.force[:, 0].mean() - columns["force_x_n"][:999].mean()) < 0.1


def test_a_topic_that_is_missing_or_of_another_type_is_named_with_what_there_is(
    tmp_path, columns, bag
):
    with pytest.raises(LogError, match=r"/cmd .*/fin/command"):
        opened(bag, topics="command=/cmd")
    with pytest.raises(LogError, match="geometry_msgs/msg/WrenchStamped"):
        opened(bag, topics="wrench=/fin/joint_states")
    topics = topics_of(columns)
    del topics["/fin/wrench"]
    write_bag(tmp_path / "run", topics | {"/force": [(0.0, wrench(0.0, 1, 1))]})
    with pytest.raises(LogError, match="--topics wrench=/force"):
        opened(tmp_path / "run")


def test_a_command_of_three_numbers_is_refused(tmp_path, columns):
    message = array(1, 2)
    message.data = np.zeros(3)
    write_bag(tmp_path / "run", topics_of(columns) | {"/fin/command": [(0.0, message)]})
    with pytest.raises(LogError, match="array of 3 numbers"):
        opened(tmp_path / "run")


def test_what_a_bag_calls_its_topics_cannot_break_the_line(tmp_path, columns):
    topics = topics_of(columns)
    del topics["/fin/wrench"]
    write_bag(tmp_path / "run", topics | {"/a\n\x1b[2J": [(0.0, wrench(0.0, 1, 1))]})
    with pytest.raises(LogError, match="no topic /fin/wrench") as error:
        opened(tmp_path / "run")
    assert str(error.value).isprintable()


def test_what_no_log_can_hold_is_found_as_no_value(tmp_path, columns):
    topics = topics_of(columns)
    time, _ = topics["/fin/wrench"][10]
    topics["/fin/wrench"][10] = (time, wrench(time, 1e300, 0))
    write_bag(tmp_path / "run", topics)
    _, issues = opened(tmp_path / "run")
    assert ("warning", "not a number") in [(issue.severity, issue.name) for issue in issues]


def test_a_damaged_bag_is_refused_in_one_line(tmp_path, bag):
    shutil.copytree(bag, tmp_path / "run")
    (file,) = (tmp_path / "run").glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for _ in range(2):
        with pytest.raises(LogError, match="softfin bag recover") as error:
            opened(tmp_path / "run")
        assert "\n" not in str(error.value)
        (tmp_path / "run" / "metadata.yaml").write_text("{")


@pytest.mark.parametrize("mode", [CompressionMode.FILE, CompressionMode.MESSAGE])
def test_a_bag_may_be_compressed_as_a_whole_or_message_by_message(tmp_path, columns, mode):
    topics = topics_of(columns, rows=200)
    write_bag(tmp_path / "plain", topics, StoragePlugin.SQLITE3)
    write_bag(tmp_path / "packed", topics, StoragePlugin.SQLITE3, compression=mode)
    (plain,), (packed,) = (opened(tmp_path / name)[0] for name in ("plain", "packed"))
    np.testing.assert_array_equal(packed.log.reading.force, plain.log.reading.force)


def number(value):
    return TYPES.types["std_msgs/msg/Float64"](float(value))


def test_numbers_become_channels_on_their_own_clock(tmp_path, columns):
    topics = topics_of(columns)
    topics["/motor/current"] = [(t, number(t)) for t in np.arange(0, 10.1, 0.04)]
    write_bag(tmp_path / "run", topics)
    (plain,), _ = opened(tmp_path / "run")
    # The force of these bags has no z, and their sensor measures no torque.
    assert plain.log.channels == {}
    options = {"topics": "current=/motor/current", "negate": "current"}
    (one,), _ = opened(tmp_path / "run", **options)
    time = one.start_s + one.log.reading.time - START_S
    np.testing.assert_allclose(one.log.channels["current_a"], -time, atol=1e-4)
    np.testing.assert_array_equal(one.log.reading.force, plain.log.reading.force)


def test_a_channel_without_such_a_topic_is_refused(bag):
    with pytest.raises(LogError, match="std_msgs/msg/Float64"):
        opened(bag, topics="current=/fin/wrench")
