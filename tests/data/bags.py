"""ROS 2 bags of a log, as a rig would record them."""

from pathlib import Path

import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

TYPES = get_typestore(Stores.ROS2_HUMBLE)

START_S = 1_700_000_000


def stamp(time: float, stamped: bool = True):
    nanoseconds = round(time * 1e9) + START_S * 10**9 if stamped else 0
    time_type = TYPES.types["builtin_interfaces/msg/Time"]
    seconds, rest = divmod(nanoseconds, 10**9)
    return TYPES.types["std_msgs/msg/Header"](time_type(seconds, rest), "fin")


def joint(time, angle, velocity, names=("fin",), stamped=True):
    none = np.zeros(0)
    velocities = none if velocity is None else np.full(len(names), float(velocity))
    positions = np.arange(len(names)) * 100.0 + float(angle)
    return TYPES.types["sensor_msgs/msg/JointState"](
        stamp(time, stamped), list(names), positions, velocities, none
    )


def wrench(time, x, y, stamped=True):
    vector = TYPES.types["geometry_msgs/msg/Vector3"]
    wrench_type = TYPES.types["geometry_msgs/msg/Wrench"]
    whole = wrench_type(vector(float(x), float(y), 0.0), vector(0.0, 0.0, 0.0))
    return TYPES.types["geometry_msgs/msg/WrenchStamped"](stamp(time, stamped), whole)


def text(words):
    return TYPES.types["std_msgs/msg/String"](words)


def array(*numbers):
    layout = TYPES.types["std_msgs/msg/MultiArrayLayout"]([], 0)
    return TYPES.types["std_msgs/msg/Float64MultiArray"](layout, np.array(numbers, float))


def write_bag(
    path: Path,
    topics: dict,
    storage: StoragePlugin = StoragePlugin.MCAP,
    delay_s: float = 0.0,
    compression: CompressionMode = CompressionMode.NONE,
) -> None:
    """`topics`: name to a list of (time, message); messages are logged `delay_s` after their
    time."""
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = Writer(path, version=9, storage_plugin=storage)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        for topic, messages in topics.items():
            kind = messages[0][1].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=TYPES)
            for time, message in messages:
                logged = round((time + delay_s) * 1e9) + START_S * 10**9
                writer.write(connection, logged, TYPES.serialize_cdr(message, kind))


def topics_of(columns, rows=1000, force_hz=500, **options) -> dict:
    """A joint at 100 Hz, a force sensor that is faster, commands where they change."""
    time = columns["time_s"][:rows]
    angle = columns["angle_rad"][:rows]
    fast = np.arange(time[0], time[-1], 1 / force_hz)
    x, y = (np.interp(fast, time, columns[name][:rows]) for name in ("force_x_n", "force_y_n"))
    command = columns["command_angle_rad"][:rows]
    issued = np.append(True, np.diff(command) != 0)
    speed = columns["command_velocity_rad_s"][:rows]
    return {
        "/fin/joint_states": [
            (t, joint(t, a, v, **options))
            for t, a, v in zip(time, angle, columns["velocity_rad_s"][:rows], strict=True)
        ],
        "/fin/wrench": [
            (t, wrench(t, *force, **options)) for t, *force in zip(fast, x, y, strict=True)
        ],
        "/fin/command": [
            (t, joint(t, a, v, **options))
            for t, a, v in zip(time[issued], command[issued], speed[issued], strict=True)
        ],
    }
