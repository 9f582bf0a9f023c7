import re
import shutil

import numpy as np
import pytest
from mcap.writer import IndexType, Writer
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionMode, StoragePlugin
from rosbags.typesys import Stores, get_typestore

from softfin.core.errors import LogError
from softfin.data.importing.clocks import build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.rosbag import find_disagreements, read_bag
from softfin.storage.bag.zero import zero_event
from softfin.storage.paths import find_recordings
from tests.data.bags import START_S, TYPES, array, joint, stamp, text, topics_of, wrench, write_bag
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


def dropped(issues):
    """Severity, role and number of the dropped messages of each topic."""
    found = []
    for issue in issues:
        if issue.name == "dropped messages":
            _, reasons = issue.message.split("dropped: ")
            numbers = re.findall(r"(?:^|, )([\d,]+) ", reasons)
            count = sum(int(number.replace(",", "")) for number in numbers)
            found.append((issue.severity, issue.column, count))
    return found


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
    with pytest.raises(LogError, match="with 3 numbers"):
        opened(tmp_path / "run")


def test_what_a_bag_calls_its_topics_cannot_break_the_line(tmp_path, columns):
    topics = topics_of(columns)
    del topics["/fin/wrench"]
    write_bag(tmp_path / "run", topics | {"/a\n\x1b[2J": [(0.0, wrench(0.0, 1, 1))]})
    with pytest.raises(LogError, match="topic /fin/wrench") as error:
        opened(tmp_path / "run")
    assert str(error.value).isprintable()


def test_a_value_that_no_log_can_hold_is_dropped_and_counted(tmp_path, columns):
    topics = topics_of(columns)
    time, _ = topics["/fin/wrench"][10]
    topics["/fin/wrench"][10] = (time, wrench(time, 1e300, 0))
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    assert dropped(issues) == [("warning", "wrench", 1)]
    check(one, columns)


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


TOPICS = {"command": "/fin/command", "joint": "/fin/joint_states", "wrench": "/fin/wrench"}


def every_fourth(messages, make):
    """The messages, and after every fourth one another that `make` returns for its time, 5 ms
    later."""
    mixed = []
    for index, (time, message) in enumerate(messages):
        mixed.append((time, message))
        if index % 4 == 0:
            mixed.append((time + 0.005, make(time + 0.005)))
    return mixed


def with_joint_states(columns, change, **options):
    topics = topics_of(columns, **options)
    topics["/fin/joint_states"] = change(topics["/fin/joint_states"])
    return topics


def test_messages_of_another_joint_are_skipped_and_counted(tmp_path, columns):
    def add_valve(messages):
        return every_fourth(messages, lambda time: joint(time, 1.0, 0.0, ("valve",)))

    write_bag(tmp_path / "run", with_joint_states(columns, add_valve))
    with pytest.raises(LogError, match="fin, valve"):
        opened(tmp_path / "run")
    with pytest.raises(LogError, match="fin, valve"):
        opened(tmp_path / "run", topics="joint=/fin/joint_states:tail")
    (one,), issues = opened(tmp_path / "run", topics="joint=/fin/joint_states:fin")
    check(one, columns)
    assert dropped(issues) == [("note", "joint", 250)]


def test_a_joint_without_a_name_is_not_mixed_with_one_that_has_one(tmp_path, columns):
    def unnamed(time):
        message = joint(time, 1.0, 0.0)
        message.name = []
        return message

    topics = with_joint_states(columns, lambda messages: every_fourth(messages, unnamed))
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match="fin, a joint without a name"):
        opened(tmp_path / "run")
    (one,), issues = opened(tmp_path / "run", topics="joint=/fin/joint_states:fin")
    check(one, columns)
    assert dropped(issues) == [("note", "joint", 250)]


def test_messages_without_a_position_are_dropped_and_counted(tmp_path, columns):
    def without(time):
        message = joint(time, 1.0, 0.0)
        message.position = np.zeros(0)
        return message

    topics = with_joint_states(columns, lambda messages: every_fourth(messages, without))
    write_bag(tmp_path / "run", topics)
    for choice in ("", ":fin"):
        (one,), issues = opened(tmp_path / "run", topics=f"joint=/fin/joint_states{choice}")
        check(one, columns)
        assert dropped(issues) == [("warning", "joint", 250)]
    only = topics | {"/fin/joint_states": [(time, without(time)) for time in (0.0, 0.01)]}
    write_bag(tmp_path / "none", only)
    with pytest.raises(LogError, match="2 without a position"):
        opened(tmp_path / "none")


def zeros_at_rate(every_s, offset_s, **options):
    def add(messages):
        times = np.arange(messages[0][0] + offset_s, messages[-1][0], every_s)
        zeros = [(time, joint(time, 0.0, None)) for time in times]
        return sorted([*messages, *zeros], key=lambda each: each[0])

    return add


@pytest.mark.parametrize("has_velocity", [True, False])
@pytest.mark.parametrize(
    ("every_s", "offset_s"),
    [(0.1, 0.0), (0.1, 0.004), (0.01, 0.003), (0.02, 0.005), (0.005, 0.001)],
)
def test_two_publishers_that_disagree_about_one_joint_are_found(
    tmp_path, columns, every_s, offset_s, has_velocity
):
    def add_zeros(messages):
        if not has_velocity:
            messages = [(t, joint(t, m.position[0], None)) for t, m in messages]
        return zeros_at_rate(every_s, offset_s)(messages)

    write_bag(tmp_path / "run", with_joint_states(columns, add_zeros))
    _, issues = opened(tmp_path / "run")
    assert ("error", "two publishers", "angle") in [
        (issue.severity, issue.name, issue.column) for issue in issues
    ]


def test_two_publishers_of_a_wrench_are_found(tmp_path, columns):
    def add_zeros(messages):
        between = [(t + 0.004, wrench(t + 0.004, 0.0, 0.0)) for t, _ in messages[::3]]
        return sorted([*messages, *between], key=lambda each: each[0])

    topics = topics_of(columns)
    topics["/fin/wrench"] = add_zeros(topics["/fin/wrench"])
    write_bag(tmp_path / "run", topics)
    _, issues = opened(tmp_path / "run")
    assert ("error", "two publishers", "force_x") in [
        (issue.severity, issue.name, issue.column) for issue in issues
    ]


@pytest.mark.parametrize("rate_hz", [25, 50, 100, 1000])
def test_a_fast_fin_and_spikes_are_not_two_publishers(rate_hz):
    time = np.arange(0, 30, 1 / rate_hz)
    angle = np.sin(2 * np.pi * 3 * time)
    assert not find_disagreements(time, angle, 0.05, 5.8).size
    spiky = angle.copy()
    spiky[5 :: rate_hz // 5] -= 6.0
    assert not find_disagreements(time, spiky, 0.05, 5.8).size
    # An encoder that wraps back and forth at half a turn.
    wrapped = (np.pi + 0.01 * (-1.0) ** np.arange(len(time)) + np.pi) % (2 * np.pi) - np.pi
    assert not find_disagreements(time, wrapped, 0.05, 5.8).size


@pytest.mark.parametrize(
    "command", [lambda angle: number(angle), lambda angle: array(angle)], ids=["number", "array"]
)
def test_a_command_may_be_one_number_with_the_velocity_that_is_given(tmp_path, columns, command):
    topics = topics_of(columns)
    topics["/fin/command"] = [(t, command(m.position[0])) for t, m in topics["/fin/command"]]
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match="--velocity"):
        opened(tmp_path / "run")
    (one,), _ = opened(tmp_path / "run", velocity_rad_s=3.1)
    check(one, columns)
    assert set(one.log.command.velocity.tolist()) == {np.float32(3.1)}


def test_an_odd_command_is_dropped_and_counted(tmp_path, columns):
    topics = topics_of(columns)
    commands = [(t, array(m.position[0], m.velocity[0])) for t, m in topics["/fin/command"]]
    topics["/fin/command"] = [*commands, (9.99, array(1.0, 2.0, 3.0))]
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    check(one, columns)
    assert dropped(issues) == [("warning", "command", 1)]


@pytest.mark.parametrize("start_s", [0, -START_S + 100])
def test_the_few_readings_without_a_stamp_are_dropped_and_counted(tmp_path, columns, start_s):
    """With stamps since 1970, or of a simulation."""
    topics = topics_of(columns)
    for messages in topics.values():
        for _, message in messages:
            message.header.stamp.sec += start_s
    for _, message in topics["/fin/joint_states"][:3]:
        message.header = stamp(0.0, stamped=False)
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    assert dropped(issues) == [("warning", "joint", 3)]
    assert len(one.log.reading.time) == 996
    assert one.start_s == pytest.approx(START_S + start_s + 0.01, abs=1e-5)
    assert one.log.reading.time[0] == pytest.approx(0.03, abs=1e-5)


@pytest.mark.parametrize("since_boot", [["joint", "wrench"], ["command"]])
def test_stamps_on_different_clocks_are_refused_unless_the_logging_times_are_chosen(
    tmp_path, columns, since_boot
):
    topics = topics_of(columns)
    for role in since_boot:
        for _, message in topics[TOPICS[role]]:
            message.header.stamp.sec -= START_S - 123
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match="--stamps logging"):
        opened(tmp_path / "run")
    (one,), _ = opened(tmp_path / "run", stamps="logging")
    check(one, columns)


def test_repeated_stamps_and_missing_numbers_are_dropped_and_counted(tmp_path, columns):
    topics = topics_of(columns, force_hz=100)
    joints = topics["/fin/joint_states"]
    topics["/fin/joint_states"] = [(t, joint(t, np.nan, np.nan)) for t, _ in joints[:200]]
    topics["/fin/joint_states"] += joints[200:]
    topics["/fin/wrench"] = [each for each in topics["/fin/wrench"] for _ in range(2)]
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    assert dropped(issues) == [("warning", "joint", 200), ("warning", "wrench", 999)]
    assert not [issue for issue in issues if issue.severity == "error"]
    assert one.log.reading.time[0] == pytest.approx(2.0, abs=1e-5)


def test_a_topic_of_which_nothing_is_usable_is_refused_with_the_reason(tmp_path, columns):
    topics = topics_of(columns)
    topics["/fin/wrench"] = [(t, wrench(t, np.nan, 0)) for t, _ in topics["/fin/wrench"]]
    write_bag(tmp_path / "run", topics)
    with pytest.raises(LogError, match="that are not numbers"):
        opened(tmp_path / "run")


def test_a_database_without_metadata_and_upper_case_names_are_bags(tmp_path, columns):
    for storage, suffix in ((StoragePlugin.SQLITE3, ".db3"), (StoragePlugin.MCAP, ".mcap")):
        folder = tmp_path / storage.name
        write_bag(folder, topics_of(columns), storage)
        (file,) = folder.glob(f"*{suffix}")
        for name in (f"run{suffix}", f"run{suffix.upper()}"):
            lone = tmp_path / "lone" / name
            lone.parent.mkdir(exist_ok=True)
            shutil.copy(file, lone)
            assert find_recordings(lone.parent) == [lone]
            (one,), _ = opened(lone)
            check(one, columns)
            lone.unlink()
        (folder / "metadata.yaml").unlink()
        assert find_recordings(folder) == [file]


def test_a_file_that_is_no_bag_is_refused_with_the_reason(tmp_path):
    for name, reason in (
        ("run.db3", "not a database"),
        ("run.mcap", "MCAP"),
        ("run.bag", "magic"),
    ):
        (tmp_path / name).write_text("time,angle\n" * 1000)
        with pytest.raises(LogError, match=reason) as error:
            opened(tmp_path / name)
        assert "truncated" not in str(error.value)
        assert "recover" not in str(error.value)


def test_a_ros_1_bag_is_read(tmp_path, columns):
    ros1 = get_typestore(Stores.ROS1_NOETIC)
    with Ros1Writer(tmp_path / "run.bag") as writer:
        for topic, messages in topics_of(columns).items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=ros1)
            for time, message in messages:
                data = ros1.serialize_ros1(as_ros1(message, ros1), kind)
                writer.write(connection, round(time * 1e9) + START_S * 10**9, data)
    assert find_recordings(tmp_path) == [tmp_path / "run.bag"]
    (one,), _ = opened(tmp_path / "run.bag")
    check(one, columns)


def as_ros1(message, ros1):
    """ROS 1's headers have a number."""
    fields = dict(vars(message))
    old = fields["header"]
    fields["header"] = ros1.types["std_msgs/msg/Header"](0, old.stamp, old.frame_id)
    return ros1.types[message.__msgtype__](**fields)


def write_mcap(path, topics, encoding="cdr", profile="ros2", camera_bytes=0, **options):
    """A file as other recorders write it, with a topic in JSON beside."""
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start(profile)
        schema = writer.register_schema("note", "jsonschema", b"{}")
        notes = writer.register_channel("/notes", "json", schema)
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            schema = writer.register_schema(kind, "ros2msg", b"")
            channel = writer.register_channel(topic, encoding, schema)
            for time, message in messages:
                logged = round(time * 1e9) + START_S * 10**9
                data = bytes(TYPES.serialize_cdr(message, kind))
                writer.add_message(channel, logged, data, logged)
        writer.add_message(notes, START_S * 10**9, b"{}" + bytes(camera_bytes), START_S * 10**9)
        writer.finish()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"profile": ""},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
        {"use_chunking": False},
        {"repeat_channels": False, "repeat_schemas": False, "use_summary_offsets": False},
        {"camera_bytes": 70 * 2**20},
    ],
)
def test_an_intact_file_is_read_whatever_index_profile_and_other_topics_it_has(
    tmp_path, columns, options
):
    path = tmp_path / "run.mcap"
    write_mcap(path, topics_of(columns), **options)
    (one,), issues = opened(path)
    check(one, columns)
    assert len(one.log.reading.time) == 999
    assert dropped(issues) == []


def test_messages_in_another_encoding_are_refused_by_its_name(tmp_path, columns):
    path = tmp_path / "run.mcap"
    for encoding, name in (("json", "json"), ("ros1", "ROS 1"), ("protobuf", "protobuf")):
        write_mcap(path, topics_of(columns, rows=20), encoding)
        with pytest.raises(LogError, match=name) as error:
            opened(path)
        assert "truncated" not in str(error.value)


def test_the_file_of_a_bag_is_read_without_its_metadata(tmp_path, bag, columns):
    shutil.copytree(bag, tmp_path / "run")
    (tmp_path / "run" / "metadata.yaml").write_text("{")
    (one,), _ = opened(tmp_path / "run")
    check(one, columns)


def test_a_simulation_that_starts_at_zero_has_a_stamp_there(tmp_path, columns, monkeypatch):
    monkeypatch.setattr("tests.data.bags.START_S", 0)
    topics = topics_of(columns, force_hz=100)
    for messages in topics.values():
        messages[0][1].header.stamp.nanosec = 0
        messages[0] = (0.0, messages[0][1])
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    assert dropped(issues) == []
    assert one.log.reading.time[0] == one.start_s == 0


def test_messages_out_of_order_are_sorted_by_their_stamps(tmp_path, columns):
    topics = topics_of(columns, force_hz=100)
    for messages in topics.values():
        for index in range(1, len(messages) - 1, 7):
            messages[index], messages[index + 1] = (
                (messages[index][0], messages[index + 1][1]),
                (messages[index + 1][0], messages[index][1]),
            )
    del topics["/fin/command"]
    topics |= {"/fin/command": topics_of(columns)["/fin/command"]}
    write_bag(tmp_path / "run", topics)
    (one,), issues = opened(tmp_path / "run")
    check(one, columns)
    assert not [issue for issue in issues if issue.severity != "note"]
