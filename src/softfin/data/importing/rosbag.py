"""Read ROS bags without ROS, from the topics of command, joint and force, and of further channels
if there are any.

Times are the header stamps if the messages of a topic have them, otherwise the logging times.
Messages that cannot be used are dropped and counted. A bag is refused if none of a topic is
left.
"""

from collections import Counter
from collections.abc import Iterable, Sized
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from softfin.core.errors import LogError, one_line
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
    BagContents,
    BagMessage,
    decode_message,
    read_contents,
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
"""Largest difference between the clocks of two topics [s]: less than between time zones. Clocks
that start at 0 with the computer or a simulation are decades behind."""

MIN_DISAGREEMENT_RAD = 0.05
"""Smallest jump that shows a second publisher [rad]: more than a fin at 3 Hz deviates from a
straight line in 10 ms."""

MIN_DISAGREEMENTS = 10
"""Smallest number of such jumps that shows a second publisher."""

OTHER_JOINTS = "of other joints"


class UnusableError(Exception):
    """A message that contains no reading; the text describes such messages."""


class Sample(NamedTuple):
    """A decoded message with its type and its time of logging [ns]."""

    kind: str
    logged_ns: int
    message: Any


def read_bag(path: Path, name: str, part: Part, config: ImportConfig) -> Recording:
    """Read one bag; raises LogError for a damaged bag, a missing topic, or a topic without usable
    messages."""
    wanted = {_role_topic(role, config)[0] for role in READABLE_TYPES}
    wanted |= {EVENTS, config.topics.get("current", CURRENT)}
    contents = read_contents(
        path, lambda topic: topic in wanted or topic.startswith(CHANNEL_TOPICS)
    )
    tracks = []
    issues = []
    clocks = {}
    for role in READABLE_TYPES:
        reader = TopicReader(contents, role, config, path)
        track, found = reader.read(name)
        issues += found
        clocks[reader.topic] = reader.offset_s
        if role == "wrench" and reader.topic == WRENCH:
            track, found = _less_zero(track, _read_zeros(contents), config, name)
            issues += found
        tracks.append(track)
    _check_clocks(clocks, path)
    tracks += _channel_tracks(contents, config, path)
    if not any("velocity" in track.channels for track in tracks):
        issues.append(derived_velocity(name))
    return Recording(name, part, _merge_tracks(tracks), tuple(issues))


def _role_topic(role: Topic, config: ImportConfig) -> tuple[str, str]:
    """Return the topic of a role, and the joint if one is chosen."""
    topic, _, joint = config.topics.get(role, DEFAULT_TOPICS[role]).partition(":")
    return topic, joint


def _check_clocks(clocks: dict[str, float], path: Path) -> None:
    """Raise LogError if stamps of different topics are on different clocks; `clocks` are the
    offsets from the logging times [s]."""
    if max(clocks.values()) - min(clocks.values()) > MAX_CLOCK_OFFSET_S:
        offsets = ", ".join(f"{topic} {-offset:,.0f} s" for topic, offset in clocks.items())
        raise LogError(
            f"{path}: the stamps are not on one clock; they precede the time of logging by "
            f"{_plain(offsets)}; use the times of logging with --stamps logging"
        )


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


def _numbers(contents: BagContents, topic: str) -> list[Sample]:
    """Return the messages of a topic that contain one number."""
    messages = [each for each in contents.messages[topic] if each.kind == FLOAT]
    samples, _ = _decoded(messages)
    return samples


def _channel_topics(contents: BagContents, config: ImportConfig) -> dict[str, str]:
    """Return the topics of other channels: the current and those of softfin's own bags."""
    topics = {CURRENT_CHANNEL: config.topics.get("current", CURRENT)}
    for topic in contents.types:
        channel = topic.removeprefix(CHANNEL_TOPICS)
        if channel not in (topic, *LOG_COLUMNS):
            topics[channel] = topic
    return topics


def _channel_tracks(contents: BagContents, config: ImportConfig, path: Path) -> list[Track]:
    """Return the other channels with numbers, each on its own clock."""
    tracks = []
    for channel, topic in _channel_topics(contents, config).items():
        samples = _numbers(contents, topic)
        if samples:
            channels = {channel: np.array([float(sample.message.data) for sample in samples])}
            if channel == CURRENT_CHANNEL:
                channels = converted({"current": channels[channel]}, config)
            tracks.append(Track(_seconds([sample.logged_ns for sample in samples]), channels))
        # Every recording has a topic for the current, but not every drive measures it.
        elif channel == CURRENT_CHANNEL and "current" in config.topics:
            raise LogError(
                f"{path}: no topic {topic} with messages of type {FLOAT} for the channel "
                f"{channel}; set another one with --topics"
            )
    return tracks


def _plain(text: str) -> str:
    """Return text from a bag as one line without control characters."""
    return printable(text, most=500)


def _listed(names: Iterable[str]) -> str:
    return _plain(", ".join(list(names)[:MAX_LISTED_TOPICS]))


def _seconds(nanoseconds: list[int]) -> Float[np.ndarray, "rows"]:
    # In double precision, nanoseconds since 1970 are exact to a quarter of a microsecond.
    return np.array(nanoseconds, np.int64) / 1e9


def _decoded(messages: Iterable[BagMessage]) -> tuple[list[Sample], list[str]]:
    """Return the decoded messages, and the reason for each that cannot be decoded."""
    samples = []
    reasons = []
    for message in messages:
        try:
            samples.append(Sample(message.kind, message.logged_ns, decode_message(message)))
        except Exception as error:
            # The generated decoder may raise any exception for damaged bytes.
            reasons.append(one_line(error))
    return samples, reasons


class TopicReader:
    """Reads the topic of one role, and counts the messages that it drops by reason."""

    def __init__(
        self, contents: BagContents, role: Topic, config: ImportConfig, path: Path
    ) -> None:
        self.topic, self._joint = _role_topic(role, config)
        self._where = f"{path}: {_plain(self.topic)}"
        self._role: Topic = role
        self._config = config
        if self.topic not in contents.types:
            raise _missing_topic_error(self.topic, role, contents.types, path)
        self._messages = contents.messages[self.topic]
        if not self._messages:
            raise LogError(f"{self._where}: no messages; record the {role} as well")
        self._dropped = Counter[str]()
        self.offset_s = 0.0
        """Median of stamp minus time of logging [s]."""

    def read(self, name: str) -> tuple[Track, list[Issue]]:
        """Return the usable readings; raises LogError if there are none."""
        samples = self._samples()
        self._choose_joint(samples)
        rows = []
        usable = []
        for sample in samples:
            try:
                rows.append(_values(sample, self._joint))
                usable.append(sample)
            except UnusableError as error:
                self._dropped[str(error)] += 1
        self._check_any(usable)
        usable_values = np.array(rows, np.float64)
        # A value too large for a float32 log is treated as missing.
        usable_values[np.abs(usable_values) > np.finfo(np.float32).max] = np.nan
        channels, issues = self._channels(usable_values, name)
        stamps, found = self._stamps(usable, name)
        issues += found
        is_stamped = np.array(stamps, np.int64) != 0
        self._drop("without a stamp", ~is_stamped)
        track = Track(_seconds(stamps), channels).take(is_stamped)
        logged = _seconds([sample.logged_ns for sample in usable])
        self.offset_s = float(np.median(track.time - logged[is_stamped]))
        if self._role == "joint":
            issues += _check_publishers(track, self.topic, name)
        track = self._increasing(track)
        self._check_any(track.time)
        return track, [*issues, *self._dropped_issues(name)]

    def _samples(self) -> list[Sample]:
        """Decode the messages of this role's types."""
        kinds = READABLE_TYPES[self._role]
        typed = [message for message in self._messages if message.kind in kinds]
        if not typed:
            raise LogError(
                f"{self._where}: type {_plain(self._messages[0].kind)}; the messages of a "
                f"{self._role} must be {' or '.join(kinds)}"
            )
        samples, reasons = _decoded(typed)
        if not samples:
            encoding = ENCODINGS.get(typed[0].encoding, typed[0].encoding)
            raise LogError(
                f"{self._where}: no message can be decoded: the encoding is {_plain(encoding)} "
                f"({_plain(reasons[0])}); record with ros2 bag record, or convert a ROS 1 bag with "
                "rosbags-convert"
            )
        self._dropped["of another type"] += len(self._messages) - len(typed)
        self._dropped["that cannot be decoded"] += len(reasons)
        return samples

    def _choose_joint(self, samples: list[Sample]) -> None:
        """Use the only joint that has positions; raises LogError if there are several and none is
        chosen."""
        joints: dict[str, None] = {}
        for kind, _, message in samples:
            if kind == JOINT_STATE:
                positions = len(message.position)
                names = message.name or [f"{index}" if index else "" for index in range(positions)]
                joints |= dict.fromkeys(names[:positions])
        listed = _listed(joint or "a joint without a name" for joint in joints)
        if self._joint and joints and self._joint not in joints:
            raise LogError(
                f"{self._where}: no positions of joint {_plain(self._joint)}, only of {listed}; "
                f"choose one with --topics {self._role}={_plain(self.topic)}:JOINT"
            )
        if not self._joint and len(joints) > 1:
            raise LogError(
                f"{self._where}: the messages are of several joints: {listed}; choose one with "
                f"--topics {self._role}={_plain(self.topic)}:JOINT"
            )
        self._joint = self._joint or next(iter(joints), "")

    def _channels(
        self, values: Float[np.ndarray, "rows values"], name: str
    ) -> tuple[Channels, list[Issue]]:
        """Convert values to channels, without those that were not measured."""
        recorded = dict(zip(TOPIC_CHANNELS[self._role], values.T, strict=True))
        channels = converted(recorded, self._config)
        if self._role == "wrench":
            # A sensor that does not measure a load reports it as zero.
            measured = {
                channel: load
                for channel, load in channels.items()
                if channel in CHANNELS or load.any()
            }
            return measured, []
        second = TOPIC_CHANNELS[self._role][-1]
        if np.isnan(values[:, 1]).all() or self._config.columns.get(second) == NO_COLUMN:
            del channels[second]
        if self._role == "joint" or second in channels:
            return channels, []
        velocity_rad_s = self._config.velocity_rad_s
        if velocity_rad_s is None:
            raise LogError(
                f"{self._where}: the commands have no velocity; use --velocity 3.1 if all commands "
                "had that velocity [rad/s]"
            )
        channels[second] = np.full(len(values), velocity_rad_s)
        text = f"{self.topic}: no velocity: {velocity_rad_s:g} rad/s everywhere, from --velocity"
        return channels, [Issue("note", "columns", name, text)]

    def _stamps(self, samples: list[Sample], name: str) -> tuple[list[int], list[Issue]]:
        """Return the times of the messages [ns]; 0 for the few without a stamp."""
        logged = [sample.logged_ns for sample in samples]
        if self._config.stamps == "logging":
            return logged, []
        stamps = [_stamp_ns(sample.message) for sample in samples]
        unstamped = stamps.count(0)
        # A command is valid until the next one, so none may be dropped.
        most = 0 if self._role == "command" else len(stamps) // 2
        if unstamped <= most or stamps == logged:
            return stamps, []
        text = (
            f"{self.topic}: {unstamped:,} of {len(stamps):,} messages have no stamp; the logging "
            "times are used"
        )
        fix = "stamp each message when it is measured, because logging adds a varying delay"
        severity: Severity = "note"
        if hasattr(samples[0].message, "header"):
            severity = "warning"
        return logged, [Issue(severity, "no stamps", name, text, fix, self._role)]

    def _increasing(self, track: Track) -> Track:
        """Drop readings that are incomplete, or not later than all readings before them."""
        is_complete = np.isfinite(track.time)
        for channel, values in track.channels.items():
            # Missing values of other channels cost no rows.
            if channel in CHANNELS:
                is_complete &= np.isfinite(values)
        self._drop("with values that are not numbers", ~is_complete)
        complete = track.take(is_complete)
        latest = np.maximum.accumulate(complete.time)
        is_later = np.append(True, complete.time[1:] > latest[:-1])[: len(latest)]
        self._drop("not later than the messages before", ~is_later)
        return complete.take(is_later)

    def _drop(self, reason: str, is_dropped: Bool[np.ndarray, "rows"]) -> None:
        self._dropped[reason] += int(is_dropped.sum())

    def _reasons(self) -> str:
        return ", ".join(f"{number:,} {reason}" for reason, number in (+self._dropped).items())

    def _check_any(self, usable: Sized) -> None:
        if not len(usable):
            raise LogError(
                f"{self._where}: none of {len(self._messages):,} messages can be used: "
                f"{self._reasons()}; record the {self._role} again"
            )

    def _dropped_issues(self, name: str) -> list[Issue]:
        """Return a warning with the dropped messages; a note if they are only of other joints."""
        dropped = +self._dropped
        if not dropped:
            return []
        text = (
            f"{self.topic}: {dropped.total():,} of {len(self._messages):,} messages are dropped: "
            f"{self._reasons()}"
        )
        severity: Severity = "note" if dropped.keys() == {OTHER_JOINTS} else "warning"
        return [Issue(severity, "dropped messages", name, text, "", self._role)]


def _check_publishers(track: Track, topic: str, name: str) -> list[Issue]:
    """Return an error if two publishers disagree about the joint."""
    order = np.argsort(track.time, kind="stable")
    angle = track.channels["angle"][order]
    rows = find_disagreements(track.time[order], angle)
    if len(rows) < MIN_DISAGREEMENTS:
        return []
    row = int(rows[0])
    message = (
        f"{topic}: jumps back and forth in {len(rows):,} of {len(angle):,} messages, first between "
        f"{angle[row - 1]:.3g} and {angle[row]:.3g} rad: two publishers disagree about the joint"
    )
    fix = (
        "stop the other publisher, such as joint_state_publisher, and record again; or choose a "
        "topic with one publisher, e.g. --topics joint=TOPIC"
    )
    return [Issue("error", "two publishers", name, message, fix, "angle", row)]


def find_disagreements(
    time: Float[np.ndarray, "rows"], angle: Float[np.ndarray, "rows"]
) -> Int[np.ndarray, "_"]:
    """Return the rows of an angle that are from another publisher than their neighbours.

    Such an angle is far from the ones before and after it, which are close to each other. So is a
    single fault of a sensor, but there the clock is as regular as elsewhere, and its neighbours
    are not faults.
    """
    if len(angle) < 3:
        return np.array([], int)
    from_previous = angle[1:-1] - angle[:-2]
    from_next = angle[1:-1] - angle[2:]
    jump = np.minimum(np.abs(from_previous), np.abs(from_next))
    is_away = (jump > MIN_DISAGREEMENT_RAD) & (jump < TURN_RAD - TURN_TOLERANCE_RAD)
    is_away &= np.abs(from_previous - from_next) < jump / 3
    is_other = np.pad(is_away, 1)
    if is_other.sum() < MIN_DISAGREEMENTS:
        return np.array([], int)
    period_s = float(np.median(np.diff(time[~is_other])))
    is_inserted = time[2:] - time[:-2] < 1.5 * period_s
    is_alternating = is_other[:-2] | is_other[2:]
    return np.flatnonzero(is_away & (is_inserted | is_alternating)) + 1


def _missing_topic_error(topic: str, role: Topic, types: dict[str, str], path: Path) -> LogError:
    topics = [f"{other} ({kind})" for other, kind in sorted(types.items())]
    # A topic with one number is rarely a command.
    likely = set(READABLE_TYPES[role]) - {FLOAT}
    fitting = [other for other, kind in types.items() if kind in likely]
    suggestion = _plain(fitting[0]) if len(fitting) == 1 else "TOPIC"
    bag = "ROS 1 bag" if path.suffix.lower() == ".bag" else "bag"
    return LogError(
        f"{path}: no topic {topic} for the {role}; the {bag} has {_listed(topics) or 'no topics'}; "
        f"set it with --topics {role}={suggestion}"
    )


def _read_zeros(contents: BagContents) -> list[tuple[float, RestForce]]:
    """Return the time [s] and value [N] of each rest force that softfin measured during the
    recording."""
    events = [each for each in contents.messages[EVENTS] if each.kind == STRING]
    samples, _ = _decoded(events)
    zeros = []
    for _, logged_ns, message in samples:
        zero = parse_zero(message.data)
        if zero is not None:
            zeros.append((logged_ns / 1e9, zero))
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


def _stamp_ns(message: Any) -> int:
    header = getattr(message, "header", None)
    return 0 if header is None else header.stamp.sec * SECOND_NS + header.stamp.nanosec


def _values(sample: Sample, joint: str) -> tuple[float, ...]:
    """Return (angle, velocity), or the force and torque in a message; raises UnusableError if it
    has none. A missing velocity is NaN."""
    kind, _, message = sample
    if kind in (ARRAY, FLOAT):
        numbers = np.atleast_1d(message.data).tolist()
        if len(numbers) not in (1, 2):
            raise UnusableError(f"with {len(numbers)} numbers instead of [angle, velocity]")
        return numbers[0], numbers[1] if len(numbers) == 2 else float("nan")
    if kind == JOINT_STATE:
        names = list(message.name) or [""]
        if joint not in names:
            raise UnusableError(OTHER_JOINTS)
        index = names.index(joint)
        if len(message.position) <= index:
            raise UnusableError("without a position")
        velocity = float(message.velocity[index]) if len(message.velocity) > index else float("nan")
        return float(message.position[index]), velocity
    wrench = getattr(message, "wrench", message)
    parts = (wrench.force, wrench.torque)
    return tuple(float(getattr(part, axis)) for part in parts for axis in "xyz")
