"""ROS 2 bags, MCAP or SQLite, read without ROS: the topics of command, joint and force in, a recording out.

A message's own stamp counts where every message of the topic has one, else the time at which it was logged.
"""

from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_typestore

from softfin.core.configuration import parse_yaml
from softfin.core.errors import LogError
from softfin.core.files import read_bytes, regular_file
from softfin.core.printable import printable
from softfin.data.checks.findings import Finding, Place
from softfin.data.importing.columns import converted
from softfin.data.importing.importing import TOPICS, ImportConfig
from softfin.data.importing.recording import Part, Recording, Track
from softfin.storage.bag.chunks import bytes_held, check_inflated_size, inflated_zstd
from softfin.storage.bag.scan import check_bag
from softfin.storage.bag.topics import DEFAULT_TOPICS

TYPES = {
    "command": ("sensor_msgs/msg/JointState", "std_msgs/msg/Float64MultiArray"),
    "joint": ("sensor_msgs/msg/JointState",),
    "wrench": ("geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Wrench"),
}

CHANNELS = {
    "command": ("command_angle", "command_velocity"),
    "joint": ("angle", "velocity"),
    "wrench": ("force_x", "force_y"),
}

STORE = get_typestore(Stores.ROS2_HUMBLE)
"""ROS 2's own definitions, not the bag's: readers make code of definitions, and a bag is anybody's."""

LONGEST_MESSAGE = 2**20
"""Bytes of a message that is read; ours have 100 to 300."""

LISTED = 12
"""Topics in a message, at most."""

LARGEST_METADATA = 300_000
"""Bytes of a bag's ``metadata.yaml``: three hundred topics, and ten seconds of the reader's."""

Values = Callable[[Any], tuple[float, float]]

_plain = partial(printable, most=500)
"""What a bag says, in one line and without a terminal's commands."""


def read_bag(path: Path, name: str, part: Part, config: ImportConfig) -> Recording:
    """One bag; raises LogError where it is damaged, lacks a topic, or a topic has messages of another type."""
    try:
        if path.is_dir():
            parse_yaml(read_bytes(path / "metadata.yaml", LARGEST_METADATA).decode())
        for file in [path] if not path.is_dir() else sorted(path.iterdir()):
            if file.suffix == ".mcap":
                check_bag(file)
            elif not file.is_dir():
                _check_file(file)
        with Reader(path) as reader:
            topics = _topics(reader, config, path)
            tracks, findings = [], []
            for role, (topic, joint) in topics.items():
                track, found = _track(reader, role, topic, joint, path, name)
                channels = converted(track.channels, config)
                if role == "command" and "command_velocity" not in channels:
                    channels["command_velocity"] = _told_velocity(track, topic, path, config)
                    text = f"{topic}: no velocity: {config.velocity_rad_s:g} rad/s throughout, by --velocity"
                    findings.append(Finding("note", "columns", Place(name), text, alike=text))
                tracks.append(Track(track.time, channels))
                findings += found
    except LogError:
        raise
    except Exception as error:
        # Damaged bags fail in the reader, its storage, its decompression or its messages, each in a way of its own.
        reason = " ".join(str(error).split()) or type(error).__name__
        way_out = "copy it again, or: ros2 bag reindex"
        raise LogError(f"{path}: truncated, or no ROS 2 bag ({_plain(reason)}); {way_out}") from None
    if not any("velocity" in track.channels for track in tracks):
        text = "no velocity in the joint's messages: it is the central difference of the angle"
        findings.append(Finding("note", "velocity derived", Place(name, "velocity"), text))
    return Recording(name, part, _joined(tracks), tuple(findings))


def _check_file(file: Path) -> None:
    with regular_file(file).open("rb") as content:
        try:
            check_inflated_size(content, bytes_held(content, file.stat().st_size))
        except LogError as error:
            raise LogError(f"{file}: {error}") from None


def _unpacked(reader: Reader, connections: list[Connection]) -> Iterator[tuple[int, bytes]]:
    """Time of logging and bytes of each message; rosbags would inflate them to any size."""
    metadata = reader.storage.metadata
    packed = metadata.compression_mode == "message"
    reader.storage.metadata = metadata._replace(compression_mode=None)
    try:
        for _, stamp, raw in reader.messages(connections):
            data = inflated_zstd(raw, LONGEST_MESSAGE) if packed else raw
            if len(data) > LONGEST_MESSAGE:
                raise LogError(f"{_plain(connections[0].topic)}: a message of over {LONGEST_MESSAGE:,} bytes")
            yield stamp, data
    finally:
        reader.storage.metadata = metadata


def _joined(tracks: list[Track]) -> tuple[Track, ...]:
    """One track of topics that are stamped alike: what needs no other clock is taken as it is."""
    first, *others = tracks
    if not all(np.array_equal(first.time, other.time) for other in others):
        return tuple(tracks)
    return (Track(first.time, {name: values for track in tracks for name, values in track.channels.items()}),)


def _topics(reader: Reader, config: ImportConfig, path: Path) -> dict[str, tuple[str, str]]:
    """Of each role the topic, and the joint's name or ""."""
    there = {connection.topic: connection.msgtype for connection in reader.connections}
    listed = _plain(", ".join(f"{topic} ({kind})" for topic, kind in sorted(there.items())[:LISTED])) or "no topics"
    chosen = {}
    for role in TOPICS:
        topic, _, joint = config.topics.get(role, DEFAULT_TOPICS[role]).partition(":")
        if topic not in there:
            fitting = [name for name, kind in there.items() if kind in TYPES[role]]
            hint = f"--topics {role}={_plain(fitting[0]) if len(fitting) == 1 else 'TOPIC'}"
            raise LogError(f"{path}: no topic {topic} for the {role}; it has {listed}; say it: {hint}")
        if there[topic] not in TYPES[role]:
            raise LogError(f"{path}: {topic} is {_plain(there[topic])}; a {role} must be {' or '.join(TYPES[role])}")
        chosen[role] = (topic, joint)
    return chosen


def _track(reader: Reader, role: str, topic: str, joint: str, path: Path, name: str) -> tuple[Track, list[Finding]]:
    connections = [connection for connection in reader.connections if connection.topic == topic]
    kind = connections[0].msgtype
    where = f"{path}: {topic}"
    if any(connection.msgtype != kind for connection in connections):
        raise LogError(f"{where}: messages of several types; record one type on each topic")
    values = _values(kind, joint, where)
    logged, stamped, rows = _rows(
        ((stamp, STORE.deserialize_cdr(data, kind)) for stamp, data in _unpacked(reader, connections)), values
    )
    if not rows:
        raise LogError(f"{where}: no messages; record the {role} too")
    own = all(stamped) or stamped == logged
    findings = []
    if not own:
        text = f"{topic}: {stamped.count(0):,} of {len(stamped):,} messages bear no stamp: the time of logging counts"
        way_out = "stamp each message where it is measured: logging adds a delay that varies"
        severity: Any = "note" if "Stamped" not in kind and "JointState" not in kind else "warning"
        findings.append(Finding(severity, "no stamps", Place(name, role), text, way_out))
    # Nanoseconds since 1970 as integers first: in double precision they are exact to a quarter of a microsecond.
    time = np.array(stamped if own else logged, np.int64) / 1e9
    pairs = np.array(rows, np.float64)
    # What a log cannot hold is no value: whoever reads on finds it and says where it is.
    pairs[np.abs(pairs) > np.finfo(np.float32).max] = np.inf
    channels = {channel: pairs[:, i] for i, channel in enumerate(CHANNELS[role])}
    if CHANNELS[role][1] in ("velocity", "command_velocity") and np.isnan(pairs[:, 1]).all():
        del channels[CHANNELS[role][1]]
    return Track(time, channels), findings


def _told_velocity(track: Track, topic: str, path: Path, config: ImportConfig) -> Float[np.ndarray, "rows"]:
    """The velocity of all commands, where their messages have none."""
    if config.velocity_rad_s is None:
        raise LogError(
            f"{path}: {topic}: no velocity in the commands; --velocity 3.1 takes its place, if all had that one [rad/s]"
        )
    return np.full(len(track.time), config.velocity_rad_s)


def _rows(
    messages: Iterable[tuple[int, Any]], values: Values
) -> tuple[list[int], list[int], list[tuple[float, float]]]:
    """Time of logging and own stamp (0 where there is none), both in ns, and the two values of each message."""
    logged, stamped, rows = [], [], []
    for stamp, message in messages:
        logged.append(stamp)
        header = getattr(message, "header", None)
        stamped.append(0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec)
        rows.append(values(message))
    return logged, stamped, rows


def _values(kind: str, joint: str, where: str) -> Values:
    def of_array(message: Any) -> tuple[float, float]:
        if len(message.data) != 2:
            raise LogError(f"{where}: an array of {len(message.data)} numbers; a command is [angle, velocity]")
        return float(message.data[0]), float(message.data[1])

    def of_joint(message: Any) -> tuple[float, float]:
        index = _index(list(message.name), len(message.position), joint, where)
        velocity = float(message.velocity[index]) if len(message.velocity) > index else float("nan")
        return float(message.position[index]), velocity

    def of_wrench(message: Any) -> tuple[float, float]:
        force = getattr(message, "wrench", message).force
        return float(force.x), float(force.y)

    return of_array if "Array" in kind else of_joint if "JointState" in kind else of_wrench


def _index(names: list[str], count: int, joint: str, where: str) -> int:
    if joint in names:
        return names.index(joint)
    if joint or count != 1:
        raise LogError(
            f"{where}: which joint? It has {_plain(', '.join(names[:LISTED])) or f'{count} without names'}; "
            "name it: TOPIC:JOINT"
        )
    return 0
