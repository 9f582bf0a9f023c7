"""Bags as the recorder writes them, and what two readers that are not softfin's find in them."""

from pathlib import Path

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from softfin.core.clock import REAL
from softfin.storage.bag.writer import BagRecorder
from tests.rig.machines import Hours


def record(path: Path, rows: int = 300, wall: bool = False) -> Path:
    """Rows at 100 Hz of a clock that need not be waited for."""
    recorder = BagRecorder(path, clock=REAL if wall else Hours())
    for k in range(rows):
        at = 1000.0 + k / 100
        recorder.command(at, 0.1 * (k // 50), 2.0)
        recorder.joint(at, 0.001 * k, 0.1, 0.25)
        recorder.wrench(at, (0.5, -0.001 * k, 0.1, 0.2, 0.3, 0.4))
        if k % 100 == 0:
            recorder.reference(at, (0.25, -0.5))
            recorder.event(at, f"row {k}")
    recorder.close()
    assert recorder.failure is None
    return path


def by_rosbags(path: Path) -> dict[str, list]:
    found: dict[str, list] = {}
    with AnyReader([path]) as reader:
        for connection, stamp, raw in reader.messages():
            found.setdefault(connection.topic, []).append(
                (stamp, *values(reader.deserialize(raw, connection.msgtype)))
            )
    return found


def by_mcap_ros2(path: Path) -> dict[str, list]:
    found: dict[str, list] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
        for _, channel, message, decoded in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, *values(decoded)))
    return found


def values(message) -> tuple:
    """All that is in a message of softfin's topics, as Python numbers."""
    if hasattr(message, "data"):
        return (message.data,)
    stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
    if hasattr(message, "wrench"):
        parts = (message.wrench.force, message.wrench.torque)
        return (
            stamp,
            message.header.frame_id,
            *(float(getattr(part, axis)) for part in parts for axis in "xyz"),
        )
    series = (message.position, message.velocity, message.effort)
    return stamp, *message.name, *(float(value) for some in series for value in some)
