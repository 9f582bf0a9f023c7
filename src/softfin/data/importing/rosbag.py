"""Reads ROS 2 bags, MCAP or SQLite, without ROS: the topics of command, joint and force go in, a
recording comes out.

The stamps of the messages count if every message of the topic has one, otherwise the times at which
they were logged.
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
"""Largest number of topics that an error message lists."""


def read_bag(path: Path, name: str, part: Part, config: ImportConfig) -> Recording:
    """Read one bag; raises LogError if it is damaged, lacks a topic, or a topic has messages of
    another type."""
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
        # Damaged bags fail in the reader, its storage, its decompression or its messages, each in
        # its own way.
        reason = _plain(one_line(error))
        raise LogError(
            f"{path}: truncated, or not a ROS 2 bag ({reason}); copy it, or: ros2 bag reindex"
        ) from None
    if not any("velocity" in track.channels for track in tracks):
        issues.append(derived_velocity(name))
    if all(np.array_equal(tracks[0].time, track.time) for track in tracks):
        # Topics with the same stamps form one track, which needs no other clock.
        channels: Channels = {}
        for track in tracks:
            channels |= track.channels
        tracks = [Track(tracks[0].time, channels)]
    return Recording(name, part, tuple(tracks), tuple(issues))


def _plain(text: str) -> str:
    """Describe the content of a bag in one line, without control characters."""
    return printable(text, most=500)


def _read_topic(
    reader: Reader, role: Topic, config: ImportConfig, path: Path, name: str
) -> tuple[Track, list[Issue]]:
    topic, _, joint = config.topics.get(role, DEFAULT_TOPICS[role]).partition(":")
    there = {connection.topic: connection.msgtype for connection in reader.connections}
    connections = [connection for connection in reader.connections if connection.topic == topic]
    where = f"{path}: {topic}"
    kind = there.get(topic, "")
    if not connections:
        topics = [f"{other} ({kind})" for other, kind in sorted(there.items())]
        listed = _plain(", ".join(topics[:MAX_LISTED_TOPICS])) or "no topics"
        fitting = [other for other, kind in there.items() if kind in READABLE_TYPES[role]]
        hint = f"--topics {role}={_plain(fitting[0]) if len(fitting) == 1 else 'TOPIC'}"
        raise LogError(f"{path}: no topic {topic} for the {role}; it has {listed}; name it: {hint}")
    if kind not in READABLE_TYPES[role] or any(
        connection.msgtype != kind for connection in connections
    ):
        raise LogError(
            f"{where} is {_plain(kind)}; a {role} must be {' or '.join(READABLE_TYPES[role])}, all "
            "of one type"
        )
    logged = []
    stamped = []
    rows = []
    for _, stamp, data in reader.messages(connections):
        # ROS 2's own definitions, not the bag's: the reader turns definitions into code, and a bag
        # can come from anybody.
        message: Any = type_store().deserialize_cdr(data, kind)
        header = getattr(message, "header", None)
        logged.append(stamp)
        stamped.append(0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec)
        rows.append(_values(message, kind, joint, where))
    if not rows:
        raise LogError(f"{where}: no messages; record the {role} too")
    issues = []
    if not (all(stamped) or stamped == logged):
        text = (
            f"{topic}: {stamped.count(0):,} of {len(stamped):,} messages have no stamp: the "
            "time of logging counts"
        )
        fix = "stamp each message where it is measured: logging adds a delay that varies"
        severity: Severity = "warning" if kind in (JOINT_STATE, WRENCH_STAMPED) else "note"
        issues.append(Issue(severity, "no stamps", name, text, fix, role))
        stamped = logged
    # Nanoseconds since 1970 as integers first: in double precision they are exact to a quarter of a
    # microsecond.
    time = np.array(stamped, np.int64) / 1e9
    pairs = np.array(rows, np.float64)
    # A value that a log cannot contain counts as missing, which is reported later.
    pairs[np.abs(pairs) > np.finfo(np.float32).max] = np.inf
    first, second = TOPIC_CHANNELS[role]
    channels = converted({first: pairs[:, 0], second: pairs[:, 1]}, config)
    if role != "wrench" and (
        np.isnan(pairs[:, 1]).all() or config.columns.get(second) == NO_COLUMN
    ):
        del channels[second]
    if role == "command" and second not in channels:
        if config.velocity_rad_s is None:
            way_out = "--velocity 3.1 takes its place, if all had that one [rad/s]"
            raise LogError(f"{where}: no velocity in the commands; {way_out}")
        channels[second] = np.full(len(time), config.velocity_rad_s)
        text = f"{topic}: no velocity: {config.velocity_rad_s:g} rad/s throughout, from --velocity"
        issues.append(Issue("note", "columns", name, text))
    return Track(time, channels), issues


def _read_zeros(reader: Reader) -> list[tuple[float, RestForce]]:
    """Return time [s] and value [N] of each zero that softfin measured at rest while recording."""
    connections = [
        each for each in reader.connections if each.topic == EVENTS and each.msgtype == STRING
    ]
    zeros = []
    # Without a list of connections the reader would read all topics.
    for _, stamp, data in reader.messages(connections) if connections else ():
        message: Any = type_store().deserialize_cdr(data, STRING)
        zero = parse_zero(message.data)
        if zero is not None:
            zeros.append((stamp / 1e9, zero))
    return zeros


def _less_zero(
    force: Track, zeros: list[tuple[float, RestForce]], config: ImportConfig, name: str
) -> tuple[Track, list[Issue]]:
    """Subtract the zeros from a force, as the session did for its controller and its logs; a bag's
    force is raw."""
    if not zeros:
        return force, []
    x, y = zeros_at(zeros, force.time).T
    zero = converted({"force_x": x, "force_y": y}, config)
    channels = {channel: values - zero[channel] for channel, values in force.channels.items()}
    text = (
        f"{WRENCH}: the force at rest is subtracted, which {EVENTS} holds "
        f"({counted(len(zeros), 'measurement')})"
    )
    return Track(force.time, channels), [Issue("note", "zeroed", name, text)]


def _values(message: Any, kind: str, joint: str, where: str) -> tuple[float, float]:
    """Return angle and velocity, or force x and y."""
    if kind == ARRAY:
        if len(message.data) != 2:
            raise LogError(
                f"{where}: an array of {len(message.data)} numbers; a command is [angle, velocity]"
            )
        return float(message.data[0]), float(message.data[1])
    if kind == JOINT_STATE:
        names = list(message.name)
        if joint not in names and (joint or len(message.position) != 1):
            unnamed = f"{len(message.position)} without names"
            listed = _plain(", ".join(names[:MAX_LISTED_TOPICS])) or unnamed
            raise LogError(f"{where}: which joint? It has {listed}; name it: TOPIC:JOINT")
        index = names.index(joint) if joint in names else 0
        velocity = float(message.velocity[index]) if len(message.velocity) > index else float("nan")
        return float(message.position[index]), velocity
    force = getattr(message, "wrench", message).force
    return float(force.x), float(force.y)
