"""Read ROS 2 bags (MCAP or SQLite) without ROS, from the topics of command, joint and force, and of
further channels if there are any.

Times are the header stamps if every message of a topic has one, otherwise the logging times.
"""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader

from softfin.core.errors import LogError, one_line
from softfin.core.log_channels import CURRENT_CHANNEL, LOG_COLUMNS
from softfin.core.printable import printable
from softfin.data.importing.clocks import Channels, Part, Recording, Track
from softfin.data.importing.columns import converted
from softfin.data.importing.importing import NO_COLUMN, ImportConfig, Topic
from softfin.data.importing.names import CHANNELS, Channel
from softfin.data.importing.tables import derived_velocity
from softfin.data.issues import Issue, Severity, counted
from softfin.storage.bag.messages import (
    CHANNEL_TOPICS,
    CURRENT,
    DEFAULT_TOPICS,
    EVENTS,
    FLOAT,
    JOINT_STATE,
    STRING,
    WRENCH,
    WRENCH_STAMPED,
    type_store,
)
from softfin.storage.bag.recovery import check_bag
from softfin.storage.bag.zero import RestForce, parse_zero, zeros_at

ARRAY = "std_msgs/msg/Float64MultiArray"

READABLE_TYPES: dict[Topic, tuple[str, ...]] = {
    "command": (JOINT_STATE, ARRAY),
    "joint": (JOINT_STATE,),
    "wrench": (WRENCH_STAMPED, "geometry_msgs/msg/Wrench"),
}

TOPIC_CHANNELS: dict[Topic, tuple[Channel, ...]] = {
    "command": ("command_angle", "command_velocity"),
    "joint": ("angle", "velocity"),
    "wrench": ("force_x", "force_y", "force_z", "torque_x", "torque_y", "torque"),
}

MAX_LISTED_TOPICS = 12
"""Maximum number of topics in an error message."""


def read_bag(path: Path, name: str, part: Part, config: ImportConfig) -> Recording:
    """Read one bag; raises LogError for a damaged bag, a missing topic or a wrong message type."""
    try:
        for file in [path] if not path.is_dir() else sorted(path.glob("*.mcap")):
            check_bag(file)
        with Reader(path) as reader:
            tracks = []
            issues = []
            for role in READABLE_TYPES:
                track, found = _read_topic(reader, role, config, path, name)
                issues += found
                if role == "wrench" and config.topics.get(role, WRENCH) == WRENCH:
                    track, found = _less_zero(track, _read_zeros(reader), config, name)
                    issues += found
                tracks.append(track)
            for channel, topic in _channel_topics(reader, config).items():
                tracks.append(_read_channel(reader, channel, topic, config, path))
    except LogError:
        raise
    except Exception as error:
        # A damaged bag may fail in the reader, the storage, the decompression or the messages, each
        # with its own exception type.
        reason = _plain(one_line(error))
        raise LogError(
            f"{path}: truncated or not a ROS 2 bag ({reason}); copy it again, or run ros2 bag "
            "reindex on it"
        ) from None
    if not any("velocity" in track.channels for track in tracks):
        issues.append(derived_velocity(name))
    return Recording(name, part, _merge_tracks(tracks), tuple(issues))


def _merge_tracks(tracks: list[Track]) -> tuple[Track, ...]:
    """Merge topics with identical stamps into one track, so that they need not be resampled."""
    first, *others = tracks
    merged: Channels = dict(first.channels)
    separate = []
    for track in others:
        if np.array_equal(first.time, track.time):
            merged |= track.channels
        else:
            separate.append(track)
    if any(channel in CHANNELS for track in separate for channel in track.channels):
        return tuple(tracks)
    return Track(first.time, merged), *separate


def _numbers(reader: Reader, topic: str) -> list[Connection]:
    """Return the connections of a topic with messages of one number."""
    return [
        each
        for each in reader.connections
        if each.topic == topic and each.msgtype == FLOAT and each.msgcount
    ]


def _channel_topics(reader: Reader, config: ImportConfig) -> dict[str, str]:
    """Return the topics of other channels: the current and those of softfin's own bags, if there
    are any."""
    topics = {}
    # Every recording has a topic for the current, but not every drive measures it.
    if "current" in config.topics or _numbers(reader, CURRENT):
        topics[CURRENT_CHANNEL] = config.topics.get("current", CURRENT)
    for connection in reader.connections:
        channel = connection.topic.removeprefix(CHANNEL_TOPICS)
        is_own = channel not in (connection.topic, *LOG_COLUMNS)
        if is_own and _numbers(reader, connection.topic):
            topics[channel] = connection.topic
    return topics


def _read_channel(
    reader: Reader, channel: str, topic: str, config: ImportConfig, path: Path
) -> Track:
    connections = _numbers(reader, topic)
    if not connections:
        raise LogError(
            f"{path}: no topic {topic} with messages of type {FLOAT} for the channel {channel}; "
            "set a different one with --topics"
        )
    logged = []
    values = []
    for _, stamp, data in reader.messages(connections):
        message: Any = type_store().deserialize_cdr(data, FLOAT)
        logged.append(stamp)
        values.append(float(message.data))
    channels = {channel: np.array(values)}
    if channel == CURRENT_CHANNEL:
        channels = converted({"current": channels[channel]}, config)
    return Track(np.array(logged, np.int64) / 1e9, channels)


def _plain(text: str) -> str:
    """Return text from a bag as one line without control characters."""
    return printable(text, most=500)


def _read_topic(
    reader: Reader, role: Topic, config: ImportConfig, path: Path, name: str
) -> tuple[Track, list[Issue]]:
    topic, _, joint = config.topics.get(role, DEFAULT_TOPICS[role]).partition(":")
    connections = [connection for connection in reader.connections if connection.topic == topic]
    if not connections:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        raise _missing_topic_error(topic, role, types, path)
    where = f"{path}: {topic}"
    kind = connections[-1].msgtype
    kinds = {connection.msgtype for connection in connections}
    if kind not in READABLE_TYPES[role] or len(kinds) > 1:
        raise LogError(
            f"{where}: type {_plain(kind)}; the messages of a {role} must all be "
            f"{' or '.join(READABLE_TYPES[role])}"
        )
    logged = []
    stamped = []
    rows = []
    for _, stamp, data in reader.messages(connections):
        # Decode with ROS 2's own message definitions, not with the bag's: the reader turns
        # definitions into code, and a bag may come from an untrusted source.
        message: Any = type_store().deserialize_cdr(data, kind)
        header = getattr(message, "header", None)
        logged.append(stamp)
        stamped.append(0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec)
        rows.append(_values(message, kind, joint, where))
    if not rows:
        raise LogError(f"{where}: no messages; record the {role} as well")
    issues = []
    if not (all(stamped) or stamped == logged):
        text = (
            f"{topic}: {stamped.count(0):,} of {len(stamped):,} messages have no stamp; the "
            "logging times are used"
        )
        fix = "stamp each message when it is measured, because logging adds a varying delay"
        severity: Severity = "warning" if kind in (JOINT_STATE, WRENCH_STAMPED) else "note"
        issues.append(Issue(severity, "no stamps", name, text, fix, role))
        stamped = logged
    # In double precision, nanoseconds since 1970 are exact to a quarter of a microsecond.
    time = np.array(stamped, np.int64) / 1e9
    values = np.array(rows, np.float64)
    # A value too large for a float32 log is treated as missing; `build_logs` reports it.
    values[np.abs(values) > np.finfo(np.float32).max] = np.inf
    channels = converted(dict(zip(TOPIC_CHANNELS[role], values.T, strict=True)), config)
    if role == "wrench":
        # A sensor that does not measure a load reports it as zero.
        channels = {
            channel: load for channel, load in channels.items() if channel in CHANNELS or load.any()
        }
    second = TOPIC_CHANNELS[role][-1]
    if role in ("command", "joint") and (
        np.isnan(values[:, 1]).all() or config.columns.get(second) == NO_COLUMN
    ):
        del channels[second]
    if role == "command" and second not in channels:
        if config.velocity_rad_s is None:
            raise LogError(
                f"{where}: the commands have no velocity; use --velocity 3.1 if all commands had "
                "that velocity [rad/s]"
            )
        channels[second] = np.full(len(time), config.velocity_rad_s)
        text = f"{topic}: no velocity: {config.velocity_rad_s:g} rad/s everywhere, from --velocity"
        issues.append(Issue("note", "columns", name, text))
    return Track(time, channels), issues


def _missing_topic_error(topic: str, role: Topic, types: dict[str, str], path: Path) -> LogError:
    topics = [f"{other} ({kind})" for other, kind in sorted(types.items())]
    listed = _plain(", ".join(topics[:MAX_LISTED_TOPICS])) or "no topics"
    fitting = [other for other, kind in types.items() if kind in READABLE_TYPES[role]]
    suggestion = _plain(fitting[0]) if len(fitting) == 1 else "TOPIC"
    return LogError(
        f"{path}: no topic {topic} for the {role}; the bag has {listed}; set it with --topics "
        f"{role}={suggestion}"
    )


def _read_zeros(reader: Reader) -> list[tuple[float, RestForce]]:
    """Return the time [s] and value [N] of each rest force that softfin measured during the
    recording."""
    connections = [
        each for each in reader.connections if each.topic == EVENTS and each.msgtype == STRING
    ]
    zeros = []
    # With an empty list of connections, the reader would read all topics.
    for _, stamp, data in reader.messages(connections) if connections else ():
        message: Any = type_store().deserialize_cdr(data, STRING)
        zero = parse_zero(message.data)
        if zero is not None:
            zeros.append((stamp / 1e9, zero))
    return zeros


def _less_zero(
    force: Track, zeros: list[tuple[float, RestForce]], config: ImportConfig, name: str
) -> tuple[Track, list[Issue]]:
    """Subtract the measured rest forces: a bag contains the raw force, while the session's
    controller and logs had them subtracted."""
    if not zeros:
        return force, []
    x, y = zeros_at(zeros, force.time).T
    zero = converted({"force_x": x, "force_y": y}, config)
    channels = dict(force.channels)
    for channel, value in zero.items():
        channels[channel] = channels[channel] - value
    text = (
        f"{WRENCH}: the rest force recorded in {EVENTS} ({counted(len(zeros), 'measurement')}) is "
        "subtracted"
    )
    return Track(force.time, channels), [Issue("note", "zeroed", name, text)]


def _values(message: Any, kind: str, joint: str, where: str) -> tuple[float, ...]:
    """Return (angle, velocity), or the force and torque in a message."""
    if kind == ARRAY:
        if len(message.data) != 2:
            raise LogError(
                f"{where}: got an array of {len(message.data)} numbers; a command must be [angle, "
                "velocity]"
            )
        return float(message.data[0]), float(message.data[1])
    if kind == JOINT_STATE:
        names = list(message.name)
        if joint not in names and (joint or len(message.position) != 1):
            unnamed = f"{len(message.position)} without names"
            listed = _plain(", ".join(names[:MAX_LISTED_TOPICS])) or unnamed
            raise LogError(
                f"{where}: joint not specified or not found among {listed}; set it with --topics "
                "ROLE=TOPIC:JOINT"
            )
        index = names.index(joint) if joint in names else 0
        velocity = float(message.velocity[index]) if len(message.velocity) > index else float("nan")
        return float(message.position[index]), velocity
    wrench = getattr(message, "wrench", message)
    parts = (wrench.force, wrench.torque)
    return tuple(float(getattr(part, axis)) for part in parts for axis in "xyz")
