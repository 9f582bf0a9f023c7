"""Reads ROS bags without ROS: the command, joint and force topics, and topics of additional
channels.

Times are the header stamps if the messages of a topic have them, otherwise the logging times.
Unusable messages are dropped and counted. If a required topic has no usable messages, the bag is
refused.
"""

from collections import Counter, defaultdict
from collections.abc import Collection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from softfin.core.errors import LogError
from softfin.core.log_channels import CURRENT_CHANNEL, LOG_COLUMNS
from softfin.core.printable import printable
from softfin.data.importing.clocks import (
    TURN_RAD,
    TURN_TOLERANCE_RAD,
    Channels,
    Part,
    Recording,
    Track,
)
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
    SECOND_NS,
    STRING,
    WRENCH,
    WRENCH_STAMPED,
)
from softfin.storage.bag.reader import (
    ENCODINGS,
    BagMessage,
    decode_message,
    read_messages,
)
from softfin.storage.bag.zero import RestForce, parse_zero, zeros_at

ARRAY = "std_msgs/msg/Float64MultiArray"

READABLE_TYPES: dict[Topic, tuple[str, ...]] = {
    "command": (JOINT_STATE, ARRAY, FLOAT),
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

MAX_CLOCK_OFFSET_S = 1800.0
"""Maximum difference between the clocks of two topics [s]. Time zones differ by more than this, and
clocks that start at 0 with the computer or a simulation are decades behind."""

MAX_DISORDER_S = 1.0
"""Maximum backward step of the time stamps that is treated as messages out of order [s]."""

MIN_DISAGREEMENT_RAD = 0.05
"""Minimum jump that indicates a second publisher [rad]; in 10 ms, a fin at 3 Hz deviates less from
a straight line."""

MIN_DISAGREEMENTS = 10
"""Minimum number of such jumps that indicates a second publisher."""

OTHER_JOINTS = "of other joints"


class UnusableError(Exception):
    """Raised for a message without a reading; the text describes such messages."""


class BagContents(NamedTuple):
    """Topic types of a bag, and the messages of the selected topics, sorted by logging time."""

    types: dict[str, str]
    messages: defaultdict[str, list[BagMessage]]


Decoded = tuple[BagMessage, Any]
"""A message, and its decoded contents."""


def read_bag(path: Path, name: str, part: Part, config: ImportConfig) -> Recording:
    """Read one bag; raises LogError if it is damaged or a topic has no usable messages."""
    topics = DEFAULT_TOPICS | {"current": CURRENT} | config.topics
    contents = _read_contents(path, [topic.partition(":")[0] for topic in topics.values()])
    tracks = []
    issues = []
    for role in READABLE_TYPES:
        track, found = _read_topic(contents, role, config, path, name)
        issues += found
        if role == "wrench" and topics[role] == WRENCH:
            track, found = _less_zero(track, _read_zeros(contents), config, name)
            issues += found
        tracks.append(track)
    _check_clocks(tracks, config, path)
    for channel, topic in _channel_topics(contents, config).items():
        tracks.append(_read_channel(contents, channel, topic, config, path))
    if not any("velocity" in track.channels for track in tracks):
        issues.append(derived_velocity(name))
    return Recording(name, part, _merge_tracks(tracks), tuple(issues))


def _read_contents(path: Path, wanted: Collection[str]) -> BagContents:
    contents = BagContents({}, defaultdict(list))
    for message in read_messages(path):
        topic = message.topic
        contents.types[topic] = message.kind
        if topic in wanted or topic == EVENTS or topic.startswith(CHANNEL_TOPICS):
            contents.messages[topic].append(message)
    for messages in contents.messages.values():
        messages.sort(key=lambda message: message.logged_ns)
    return contents


def _check_clocks(tracks: list[Track], config: ImportConfig, path: Path) -> None:
    """Raise LogError if the topics are stamped by different clocks."""
    begin = max(float(track.time.min()) for track in tracks)
    end = min(float(track.time.max()) for track in tracks)
    if config.stamps == "header" and begin - end > MAX_CLOCK_OFFSET_S:
        raise LogError(
            f"{path}: the timestamps are from different clocks: one topic ends at {end:,.0f} s, "
            f"another starts at {begin:,.0f} s; use the logging times with --stamps logging"
        )


def _merge_tracks(tracks: list[Track]) -> tuple[Track, ...]:
    """Merge topics with identical time stamps into one track, so that they need not be
    resampled."""
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


def _channel_topics(contents: BagContents, config: ImportConfig) -> dict[str, str]:
    """Return the topics of additional channels: the current and the topics of softfin's own bags,
    if present."""
    topics = {}
    # Every softfin bag has a topic for the current, but not every drive measures it.
    if "current" in config.topics or contents.messages[CURRENT]:
        topics[CURRENT_CHANNEL] = config.topics.get("current", CURRENT)
    for topic, messages in contents.messages.items():
        channel = topic.removeprefix(CHANNEL_TOPICS)
        is_own = channel not in (topic, *LOG_COLUMNS)
        if is_own and messages[0].kind == FLOAT:
            topics[channel] = topic
    return topics


def _read_channel(
    contents: BagContents, channel: str, topic: str, config: ImportConfig, path: Path
) -> Track:
    decoded = _decoded(contents.messages[topic], (FLOAT,), Counter())
    if not decoded:
        raise LogError(
            f"{path}: no topic {topic} with messages of type {FLOAT} for the channel {channel}; "
            "set a different one with --topics"
        )
    channels = {channel: np.array([float(content.data) for _, content in decoded])}
    if channel == CURRENT_CHANNEL:
        channels = converted({"current": channels[channel]}, config)
    return Track(_seconds([message.logged_ns for message, _ in decoded]), channels)


def _plain(text: str) -> str:
    """Return text from a bag as one line without control characters."""
    return printable(text, most=500)


def _seconds(nanoseconds: list[int]) -> Float[np.ndarray, "rows"]:
    # In double precision, nanoseconds since 1970 are exact to a quarter of a microsecond.
    return np.array(nanoseconds, np.int64) / 1e9


def _decoded(
    messages: list[BagMessage], kinds: Collection[str], dropped: Counter[str]
) -> list[Decoded]:
    """Decode messages of the given types, and count all other messages by reason."""
    decoded = []
    for message in messages:
        encoding = ENCODINGS.get(message.encoding)
        if message.kind not in kinds:
            dropped[f"of type {message.kind}"] += 1
        elif encoding is None:
            dropped[f"encoded as {message.encoding}"] += 1
        else:
            try:
                decoded.append((message, decode_message(message)))
            except Exception:
                # The generated decoder may raise any exception for damaged bytes.
                dropped[f"that cannot be decoded as {encoding}"] += 1
    return decoded


def _read_topic(
    contents: BagContents, role: Topic, config: ImportConfig, path: Path, name: str
) -> tuple[Track, list[Issue]]:
    topic, _, joint = config.topics.get(role, DEFAULT_TOPICS[role]).partition(":")
    where = f"{path}: {topic}"
    messages = contents.messages[topic]
    if not messages:
        raise _missing_topic_error(topic, role, contents.types, path)
    dropped = Counter[str]()
    decoded = _decoded(messages, READABLE_TYPES[role], dropped)
    joint = _chosen_joint(decoded, joint, where, role)
    usable = []
    rows = []
    for message, content in decoded:
        try:
            rows.append(_values(message.kind, content, joint))
            usable.append((message, content))
        except UnusableError as error:
            dropped[str(error)] += 1
    if not rows:
        raise _unusable_error(where, role, dropped)
    values = np.array(rows, np.float64)
    # A value too large for a float32 log is treated as missing.
    values[np.abs(values) > np.finfo(np.float32).max] = np.nan
    time, issues = _times(usable, role, topic, config, name)
    # Messages may be logged out of order; a larger backward step is a restart of the clock.
    steps = np.diff(time[np.isfinite(time)])
    if steps.min(initial=0.0) > -MAX_DISORDER_S:
        order = np.argsort(time, kind="stable")
        time = time[order]
        values = values[order]
    channels, found = _topic_channels(values, role, config, where, name)
    issues += found
    track = Track(time, channels)
    is_stamped = np.isfinite(time)
    if role != "command":
        issues += _check_publishers(track.take(is_stamped), role, topic, name)
    # Missing values in additional channels cost no rows.
    needed = np.array([channels[channel] for channel in channels.keys() & set(CHANNELS)])
    is_finite = np.isfinite(needed).all(axis=0)
    dropped["without a timestamp"] = int((~is_stamped).sum())
    dropped["with values that are not numbers"] = int((is_stamped & ~is_finite).sum())
    track = track.take(is_stamped & is_finite)
    if not len(track.time):
        raise _unusable_error(where, role, dropped)
    is_repeated = np.diff(track.time, prepend=np.nan) == 0
    dropped["with a repeated timestamp"] = int(is_repeated.sum())
    if +dropped:
        text = f"{topic}: of {len(messages):,} messages, some are dropped: {_reasons(dropped)}"
        severity: Severity = "note" if (+dropped).keys() == {OTHER_JOINTS} else "warning"
        issues.append(Issue(severity, "dropped messages", name, _plain(text), "", role))
    return track.take(~is_repeated), issues


def _unusable_error(where: str, role: Topic, dropped: Counter[str]) -> LogError:
    return LogError(
        f"{where}: no message can be used: {_reasons(dropped)}; a {role} must be "
        f"{' or '.join(READABLE_TYPES[role])}, in {' or '.join(ENCODINGS.values())}; record with "
        "ros2 bag record, or convert a ROS 1 bag with rosbags-convert"
    )


def _reasons(dropped: Counter[str]) -> str:
    return _plain(", ".join(f"{number:,} {reason}" for reason, number in (+dropped).items()))


def _chosen_joint(decoded: list[Decoded], joint: str, where: str, role: Topic) -> str:
    """Return the joint to read, by default the only one with positions; raises LogError if it does
    not exist or there are several."""
    joints: dict[str, None] = {}
    for message, content in decoded:
        if message.kind == JOINT_STATE:
            positions = len(content.position)
            names = content.name or [f"({number} without a name)" for number in range(1, positions)]
            joints |= dict.fromkeys([*names, ""][:positions])
    if not joint and len(joints) == 1:
        return next(iter(joints))
    if joints and (not joint or joint not in joints):
        listed = ", ".join(
            [name or "a joint without a name" for name in joints][:MAX_LISTED_TOPICS]
        )
        raise LogError(
            f"{where}: joint not chosen or not found among {_plain(listed)}; choose one with "
            f"--topics {role}=TOPIC:JOINT"
        )
    return joint


def _times(
    decoded: list[Decoded], role: Topic, topic: str, config: ImportConfig, name: str
) -> tuple[Float[np.ndarray, "rows"], list[Issue]]:
    """Return the times of messages [s]; NaN for a few messages without a time stamp."""
    logged = [message.logged_ns for message, _ in decoded]
    if config.stamps == "logging":
        return _seconds(logged), []
    stamps = []
    for _, content in decoded:
        header = getattr(content, "header", None)
        stamps.append(0 if header is None else header.stamp.sec * SECOND_NS + header.stamp.nanosec)
    unstamped = stamps.count(0)
    if not unstamped or stamps == logged:
        return _seconds(stamps), []
    if role != "command" and unstamped <= len(stamps) / 2:
        return np.where(np.array(stamps) == 0, np.nan, _seconds(stamps)), []
    # A command is valid until the next one, so no command may be dropped.
    text = (
        f"{topic}: {unstamped:,} of {len(stamps):,} messages have no timestamp; the logging times "
        "are used"
    )
    fix = "timestamp each message at the time of measurement, because logging adds a varying delay"
    severity: Severity = "warning" if hasattr(decoded[0][1], "header") else "note"
    return _seconds(logged), [Issue(severity, "no stamps", name, text, fix, role)]


def _topic_channels(
    values: Float[np.ndarray, "rows values"],
    role: Topic,
    config: ImportConfig,
    where: str,
    name: str,
) -> tuple[Channels, list[Issue]]:
    """Convert values to channels, without unmeasured channels."""
    channels = converted(dict(zip(TOPIC_CHANNELS[role], values.T, strict=True)), config)
    if role == "wrench":
        # Sensors report zero for loads that they do not measure.
        channels = {
            channel: load for channel, load in channels.items() if channel in CHANNELS or load.any()
        }
    second = TOPIC_CHANNELS[role][-1]
    if role in ("command", "joint") and (
        np.isnan(values[:, 1]).all() or config.columns.get(second) == NO_COLUMN
    ):
        del channels[second]
    if role != "command" or second in channels:
        return channels, []
    if config.velocity_rad_s is None:
        raise LogError(
            f"{where}: the commands have no velocity; use --velocity 3.1 if all commands had that "
            "velocity [rad/s]"
        )
    channels[second] = np.full(len(values), config.velocity_rad_s)
    text = f"command: no velocity: {config.velocity_rad_s:g} rad/s everywhere, from --velocity"
    return channels, [Issue("note", "columns", name, text)]


def _check_publishers(track: Track, role: Topic, topic: str, name: str) -> list[Issue]:
    """Return an error if two publishers disagree about the joint or the wrench."""
    channel = TOPIC_CHANNELS[role][0]
    values = track.channels[channel]
    least = MIN_DISAGREEMENT_RAD
    most = TURN_RAD - TURN_TOLERANCE_RAD
    if role == "wrench":
        least = 0.2 * float(np.ptp(np.percentile(values, [1, 99])))
        most = np.inf
    rows = find_disagreements(track.time, values, least, most)
    if len(rows) < MIN_DISAGREEMENTS:
        return []
    message = (
        f"{topic}: {channel} jumps back and forth in {len(rows):,} of {len(track.time):,} "
        f"messages: two publishers disagree about the {role}"
    )
    fix = (
        "stop the other publisher, such as joint_state_publisher, and record again; or choose a "
        f"topic with one publisher, e.g. --topics {role}=TOPIC"
    )
    return [Issue("error", "two publishers", name, message, fix, channel, int(rows[0]))]


def find_disagreements(
    time: Float[np.ndarray, "rows"],
    values: Float[np.ndarray, "rows"],
    least: float,
    most: float,
) -> Int[np.ndarray, "_"]:
    """Return the rows of a channel that are from a different publisher than their neighbours.

    Such a value differs by `least` to `most` from the values before and after it, which are close
    to each other. A single sensor fault looks similar, but its time stamp is regular, and its
    neighbours are valid.
    """
    to_next = np.diff(values)[1:]
    from_previous = np.diff(values)[:-1]
    jump = np.minimum(np.abs(from_previous), np.abs(to_next))
    is_away = (jump > least) & (jump < most)
    is_other = np.pad(is_away & (np.abs(from_previous + to_next) < jump / 3), 1)
    rows = np.flatnonzero(is_other)
    if not rows.size:
        return rows
    regular = time[~is_other]
    is_inserted = time[rows + 1] - time[rows - 1] < 1.5 * np.median(np.diff(regular))
    is_alternating = is_other[rows - 1] | is_other[rows + 1]
    return np.asarray(rows[is_inserted | is_alternating])


def _missing_topic_error(topic: str, role: Topic, types: dict[str, str], path: Path) -> LogError:
    topics = [f"{other} ({kind})" for other, kind in sorted(types.items())]
    listed = _plain(", ".join(topics[:MAX_LISTED_TOPICS])) or "no topics"
    # A topic with a single number is rarely a command.
    likely = set(READABLE_TYPES[role]) - {FLOAT}
    fitting = [other for other, kind in types.items() if kind in likely]
    suggestion = _plain(fitting[0]) if len(fitting) == 1 else "TOPIC"
    bag = "ROS 1 bag" if path.suffix.lower() == ".bag" else "bag"
    fix = f"set it with --topics {role}={suggestion}"
    if not likely & set(types.values()):
        fix = f"record the {role} as well, as {' or '.join(READABLE_TYPES[role])}"
    return LogError(
        f"{path}: no messages on topic {topic} for the {role}; the {bag} has {listed}; {fix}"
    )


def _read_zeros(contents: BagContents) -> list[tuple[float, RestForce]]:
    """Return the time [s] and value [N] of each rest force measured by softfin during the
    recording."""
    zeros = []
    for message, content in _decoded(contents.messages[EVENTS], (STRING,), Counter()):
        zero = parse_zero(content.data)
        if zero is not None:
            zeros.append((message.logged_ns / 1e9, zero))
    return zeros


def _less_zero(
    force: Track, zeros: list[tuple[float, RestForce]], config: ImportConfig, name: str
) -> tuple[Track, list[Issue]]:
    """Subtract the measured rest forces: a bag contains the raw force, whereas the controller and
    the logs of the session use the force after subtraction."""
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


def _values(kind: str, message: Any, joint: str) -> tuple[float, ...]:
    """Return (angle, velocity), or the force and torque, in a message; raises UnusableError if
    there are none. A missing velocity is NaN."""
    if kind in (ARRAY, FLOAT):
        numbers = np.atleast_1d(message.data).tolist()
        if len(numbers) not in (1, 2):
            raise UnusableError(f"with {len(numbers)} numbers instead of [angle, velocity]")
        return numbers[0], numbers[1] if len(numbers) == 2 else float("nan")
    if kind == JOINT_STATE:
        names = message.name or [""]
        index = names.index(joint) if joint in names else 0
        if len(message.position) <= index:
            raise UnusableError("without a position")
        if joint not in names:
            raise UnusableError(OTHER_JOINTS)
        velocity = float(message.velocity[index]) if len(message.velocity) > index else float("nan")
        return float(message.position[index]), velocity
    wrench = getattr(message, "wrench", message)
    parts = (wrench.force, wrench.torque)
    return tuple(float(getattr(part, axis)) for part in parts for axis in "xyz")
