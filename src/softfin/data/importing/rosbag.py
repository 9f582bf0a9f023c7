"""Read ROS 2 bags (MCAP or SQLite) without ROS, from the topics of command, joint and force.

Times are the header stamps if every message of a topic has one, otherwise the logging times.
"""

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import Reader

from softfin.core.errors import LogError, one_line
from softfin.core.printable import printable
from softfin.data.importing.clocks import Channels, Part, Recording, Track
from softfin.data.importing.columns import converted
from softfin.data.importing.importing import NO_COLUMN, ImportConfig, Topic
from softfin.data.importing.names import Channel
from softfin.data.importing.tables import derived_velocity
from softfin.data.issues import Issue, Severity, counted
from softfin.storage.bag.messages import (
    DEFAULT_TOPICS,
    EVENTS,
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

TOPIC_CHANNELS: dict[Topic, tuple[Channel, Channel]] = {
    "command": ("command_angle", "command_velocity"),
    "joint": ("angle", "velocity"),
    "wrench": ("force_x", "force_y"),
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
    if all(np.array_equal(tracks[0].time, track.time) for track in tracks):
        # Topics with identical stamps form one track, so that they need not be resampled.
        channels: Channels = {}
        for track in tracks:
            channels |= track.channels
        tracks = [Track(tracks[0].time, channels)]
    return Recording(name, part, tuple(tracks), tuple(issues))


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
    pairs = np.array(rows, np.float64)
    # A value too large for a float32 log is treated as missing; `build_logs` reports it.
    pairs[np.abs(pairs) > np.finfo(np.float32).max] = np.inf
    first, second = TOPIC_CHANNELS[role]
    channels = converted({first: pairs[:, 0], second: pairs[:, 1]}, config)
    if role != "wrench" and (
        np.isnan(pairs[:, 1]).all() or config.columns.get(second) == NO_COLUMN
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
    channels = {channel: values - zero[channel] for channel, values in force.channels.items()}
    text = (
        f"{WRENCH}: the rest force recorded in {EVENTS} ({counted(len(zeros), 'measurement')}) is "
        "subtracted"
    )
    return Track(force.time, channels), [Issue("note", "zeroed", name, text)]


def _values(message: Any, kind: str, joint: str, where: str) -> tuple[float, float]:
    """Return (angle, velocity) or (force x, force y) of a message."""
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
    force = getattr(message, "wrench", message).force
    return float(force.x), float(force.y)
