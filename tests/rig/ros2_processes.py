"""Two processes on DDS, alone on loopback: `python -m tests.rig.ros2_processes CASE FOLDER` and its
child.

The child knows nothing of softfin: its types are written by hand, and cyclonedds makes their bytes.
Where it can be had, both are in a network namespace of their own; else Cyclone DDS is kept to
loopback.
"""

import itertools
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import byte, float64, int32, sequence, uint32
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from tests.alone import raise_loopback, told_by
from tests.patience import HANG_S

DEAD_MAN_S = 0.2
"""Time without a command after which the driver stops its motor [s]."""

LOOPBACK = (
    '<CycloneDDS><Domain Id="any"><General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/>'
    "</Interfaces><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    '<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>'
)

QUALITY = Qos(
    Policy.Reliability.Reliable(100_000_000),
    Policy.History.KeepLast(10),
    Policy.Durability.Volatile,
)

RELIABLE = Policy.Reliability.Reliable(100_000_000)

OFFERS = {
    "reliable": QUALITY,
    "best_effort": Qos(
        Policy.Reliability.BestEffort, Policy.History.KeepLast(10), Policy.Durability.Volatile
    ),
    "latched": Qos(RELIABLE, Policy.History.KeepLast(1), Policy.Durability.TransientLocal),
    "exclusive": Qos(
        RELIABLE,
        Policy.History.KeepLast(10),
        Policy.Durability.Volatile,
        Policy.Ownership.Exclusive,
    ),
}
"""What publishers of a stop offer; no node of ROS 2 offers the last one, which no reader of softfin
hears."""


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    force: Vector3
    torque: Vector3


@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    header: Header
    wrench: Wrench


@dataclass
class String(IdlStruct, typename="std_msgs::msg::dds_::String_"):
    data: str


@dataclass
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    data: float64


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class DiagnosticStatus(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: byte
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class DiagnosticArray(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: sequence[DiagnosticStatus]


@dataclass
class Bool(IdlStruct, typename="std_msgs::msg::dds_::Bool_"):
    data: bool


def within(case: str, folder: Path) -> dict[str, Any]:
    """What a case tells, in a domain that no other test uses, because even processes in separate
    namespaces share the locks of this computer."""
    domain = str(1 + os.getpid() % 200)
    return told_by("tests.rig.ros2_processes", folder, case, ROS_DOMAIN_ID=domain)


def plant(_: Path) -> dict[str, Any]:
    """A machine of topics on the child's driver: open, read, move, stop."""
    from softfin.core.errors import DeviceError
    from softfin.rig.machine import Target
    from softfin.rig.ros2.plant import Ros2Machine

    machine = Ros2Machine(_plant_config())
    machine.open()
    there = machine._topics.transport.topics()
    at_rest = [_ticked(machine) for _ in range(30)]
    machine.enable()
    machine.command(Target(0.5, 2.0))
    # However slow this computer is, the driver gets there, and most of the readings are new.
    moved = _ticked_until(
        machine, lambda samples: samples[-1].angle > 0.4999 and _count_fresh(samples) > 40
    )
    machine.command(Target(-1.0, 1.0))
    _ticked_until(machine, lambda samples: samples[-1].angle < 0.4)
    machine.stop()
    stopped = _ticked_until(machine, _is_still)
    while machine.counters()["joint_received"] <= 100:
        _ticked(machine)
    counters = machine.counters()
    machine.close()
    silent = Ros2Machine(_plant_config(wrench_topic="/elsewhere", wait_s=1.0))
    try:
        silent.open()
        complaint = ""
    except DeviceError as error:
        complaint = str(error)
    return {
        "there": there,
        "angles": [[sample.angle for sample in part] for part in (at_rest, moved, stopped)],
        "ages": [sample.time for sample in at_rest],
        "forces": [[sample.wrench[0], sample.velocity] for sample in moved],
        "complaints": [sample.complaints for part in (at_rest, moved, stopped) for sample in part],
        "counters": counters,
        "silent": complaint,
    }


def _plant_config(**changes: Any) -> Any:
    from softfin.rig.ros2.config import Ros2PlantConfig

    limits = {
        "angle_min_rad": -1.5,
        "angle_max_rad": 1.5,
        "velocity_min_rad_s": 1.0,
        "velocity_max_rad_s": 3.0,
    }
    config = {
        "joint_topic": "/joint",
        "joint_name": "fin",
        "wrench_topic": "/wrench",
        "frame": "x,y",
        "command_topic": "/command",
        "stop_topic": "/stop",
        "wait_s": 120.0,
        "limits": limits,
    }
    return Ros2PlantConfig.build(config | changes)


def sensor(_: Path) -> dict[str, Any]:
    """A force sensor on the child's topic, until the child publishes it twice."""
    from examples.ros2_sensor.softfin_ros2_sensor import TopicSensorConfig, topic_sensor

    from softfin.rig import streamed_sensor

    streamed_sensor.FIRST_WAIT_S = HANG_S
    values = {"topic": "/wrench", "rate_hz": 50.0, "filter_delay_s": 0.0, "frame": "x,y"}
    made = topic_sensor(TopicSensorConfig.build(values | {"connection": {"transport": "dds"}}))
    made.open()
    wrench = made.read().wrench
    (described, *_) = made.checks()
    publishers: list[str] = []
    while not publishers:
        time.sleep(0.005)
        made.keep_up()
        publishers = [line for line in made.complaints() if "publishers" in line]
    counters = made.counters()
    made.close()
    return {
        "wrench": wrench,
        "described": described.text,
        "publishers": publishers,
        "counters": counters,
    }


def node(_: Path) -> dict[str, Any]:
    """A node: the child reads what it says, then asks for a force and a stop."""
    from softfin.core.errors import RigError
    from softfin.rig.machine import Sample, Target
    from softfin.rig.ros2.config import NodeConfig, TransportConfig
    from softfin.rig.ros2.inputs import EmergencyStop, OnceReporter
    from softfin.rig.ros2.node import RosNode
    from softfin.rig.ros2.plant import open_transport
    from softfin.rig.stop import StopRequest

    # Pytest's path is not that of its processes.
    sys.path.append(str(Path(__file__).parents[2] / "ros2" / "softfin_ros"))
    from softfin_ros.status import FinStatus

    transport = open_transport(TransportConfig(transport="dds"))
    topics = NodeConfig(reference_timeout_s=None)
    emergency_stop = EmergencyStop(transport, topics.stop_topic, OnceReporter(print))
    status = FinStatus(transport, "/fin/stop_reason", "fin", print)
    ros_node = RosNode(
        transport, topics, print, torque_constant_nm_a=2.0, emergency_stop=emergency_stop
    )
    reference = stop = None
    deadline = time.monotonic() + HANG_S
    tick = 0
    while stop is None and time.monotonic() < deadline:
        tick += 1
        now = time.monotonic()
        sample = Sample(now, 0.25, -0.5, 0.5, None, now - 0.02, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), ())
        ros_node.observe(StopRequest(), sample, Target(0.001 * tick, 2.0))
        status.add(sample)
        status.update("active", "")
        reference = ros_node.reference() or reference
        stop = ros_node.stop_reason()
        time.sleep(0.01)
    listening = ros_node.joint.readers()
    refusals = []
    try:
        emergency_stop.reset()
    except RigError as error:
        refusals.append(str(error))
    transport.close()
    return {
        "reference": reference,
        "stop": stop,
        "unsent": ros_node.counters()["unsent"],
        "listening": listening,
        "refusals": refusals,
    }


def robot(folder: Path) -> dict[str, Any]:
    """A robot's node: the child plays four fins, asks for a wrench, then for a stop."""
    from softfin.core.errors import SafetyStop
    from softfin.rig.ros2.config import TransportConfig
    from softfin.rig.ros2.plant import open_transport
    from softfin.rig.stop import StopRequest
    from softfin.robot.description import load_robot
    from softfin.robot.node import RobotNode
    from softfin.robot.node_config import RobotNodeConfig

    transport = open_transport(TransportConfig(transport="dds"))
    config = RobotNodeConfig.build(
        {"max_thrust": 4.0, "wait_s": 120.0, "fin_timeout_s": HANG_S, "reference_timeout_s": HANG_S}
    )
    told: list[str] = []
    try:
        RobotNode(transport, load_robot("ucat"), config, told.append).run(StopRequest())
    except SafetyStop as error:
        reason = str(error)
    transport.close()
    seen: dict[str, Any] = json.loads((folder / "seen.json").read_text())
    return seen | {"error": reason, "told": told}


def stops(_: Path) -> dict[str, Any]:
    """Emergency stops of which the child publishes each in its own way, and references that cannot
    be heard."""
    from softfin.rig.ros2.config import NodeConfig, TransportConfig
    from softfin.rig.ros2.inputs import EmergencyStop, OnceReporter
    from softfin.rig.ros2.node import RosNode
    from softfin.rig.ros2.plant import open_transport

    transport = open_transport(TransportConfig(transport="dds"))
    there: set[str] = set()
    while "/stop/latched" not in there:
        # Each look gives what is new.
        there |= set(transport.topics())
        time.sleep(0.005)
    told: list[str] = []
    emergency_stops = {
        name: EmergencyStop(transport, f"/stop/{name}", OnceReporter(told.append))
        for name in OFFERS
    }
    ros_node = RosNode(transport, NodeConfig(reference_topic="/stop/reference"), told.append)
    heard: dict[str, str | None] = {}
    while len(told) < 2 or sum(reason is not None for reason in heard.values()) < len(OFFERS) - 1:
        ros_node.reference()
        heard = {name: emergency_stop.reason() for name, emergency_stop in emergency_stops.items()}
        time.sleep(0.005)
    transport.close()
    return {"heard": heard, "told": told}


def dead_man(folder: Path) -> dict[str, Any]:
    """A third process moves the child's fin and is killed in the middle of a stroke."""
    host = subprocess.Popen(
        [sys.executable, "-m", "tests.rig.ros2_processes", "host_child", str(folder)]
    )
    path = folder / "driver.json"
    while not path.exists():
        # On a busy computer the driver's switch may act before; then the fin goes on with the next
        # command.
        assert host.poll() is None, f"the host ended with {host.returncode}"
        time.sleep(0.005)
    host.kill()
    host.wait()
    (folder / "killed").touch()
    while not (folder / "rest.json").exists():
        time.sleep(0.005)
    driver: dict[str, Any] = json.loads((folder / "rest.json").read_text())
    return driver


def host_child(_: Path) -> None:
    """Moves a fin to 1.5 rad at 1 rad/s, until it is killed."""
    from softfin.rig.machine import Target
    from softfin.rig.ros2.plant import Ros2Machine

    machine = Ros2Machine(_plant_config())
    machine.open()
    machine.enable()
    machine.command(Target(1.5, 1.0))
    while True:
        _ticked(machine)


def _ticked(machine: Any) -> Any:
    time.sleep(0.01)
    return machine.read()


def _ticked_until(machine: Any, is_enough: Callable[[list[Any]], bool]) -> list[Any]:
    """All samples until they are enough, which the time limit of `within` guards."""
    samples = [_ticked(machine)]
    while not is_enough(samples):
        samples.append(_ticked(machine))
    return samples


def _is_still(samples: list[Any]) -> bool:
    """Whether the last readings are new and of one angle."""
    last = samples[-20:]
    return len({sample.angle for sample in last}) == 1 and _count_fresh(last) > 10


def _count_fresh(samples: list[Any]) -> int:
    return sum(sample.time > before.time for before, sample in itertools.pairwise(samples))


class Child:
    """Writers and readers of the other process."""

    def __init__(self) -> None:
        self.domain = Domain(int(os.environ["ROS_DOMAIN_ID"]), LOOPBACK)
        self.participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))

    def topic(self, name: str, kind: Any) -> Any:
        return Topic(self.participant, f"rt{name}", kind, qos=QUALITY)

    def writer(self, name: str, kind: Any, quality: Qos = QUALITY) -> Any:
        return DataWriter(self.participant, self.topic(name, kind), qos=quality)

    def reader(self, name: str, kind: Any, quality: Qos = QUALITY) -> Any:
        return DataReader(self.participant, self.topic(name, kind), qos=quality)


def taken(reader: Any) -> list[Any]:
    """Without the notes that a writer has left."""
    return [sample for sample in reader.take(10) if not isinstance(sample, InvalidSample)]


def header(frame: str = "driver") -> Header:
    seconds, rest = divmod(time.time_ns(), 10**9)
    return Header(Time(seconds, rest), frame)


def plant_child(_: Path) -> None:
    """A driver: a joint that goes to its command at the velocity asked for, and brakes for good
    when told to stop."""
    child = Child()
    joints = child.writer("/joint", JointState)
    wrenches = child.writer("/wrench", WrenchStamped)
    commands = child.reader("/command", JointState)
    stops = child.reader("/stop", Bool)
    angle = 0.0
    target = 0.0
    speed = 0.0
    stopped = False
    while True:
        for command in taken(commands):
            target = command.position[command.name.index("fin")]
            speed = command.velocity[0]
        stopped = stopped or any(stop.data for stop in taken(stops))
        rest = 0.0 if stopped else target - angle
        step = max(-speed * 0.005, min(speed * 0.005, rest))
        angle += step
        velocity = step / 0.005
        joints.write(JointState(header(), ["other", "fin"], [9.0, angle], [9.0, velocity], []))
        force = Vector3(-0.5 * velocity, 0.1, 0.2)
        wrenches.write(WrenchStamped(header(), Wrench(force, Vector3(0.01, 0.02, 0.03))))
        time.sleep(0.005)


def dead_man_child(folder: Path) -> None:
    """A driver with a dead man's switch: without a command for 0.2 s its fin stops, until the next
    one comes."""
    child = Child()
    joints = child.writer("/joint", JointState)
    wrenches = child.writer("/wrench", WrenchStamped)
    commands = child.reader("/command", JointState)
    angle = 0.0
    target = 0.0
    speed = 0.0
    heard_at = 0.0
    heard_angle = 0.0
    resting = 0
    while resting < 40:
        for command in taken(commands):
            target = command.position[0]
            speed = command.velocity[0]
            heard_at = time.monotonic()
            heard_angle = angle
        # The fin moves by steps: a busy computer makes it slower, never faster. A tenth of the
        # speed leaves 14 s to kill the host before it is at its target.
        step = 0.0
        if time.monotonic() - heard_at < DEAD_MAN_S:
            step = min(0.1 * speed * 0.005, target - angle)
        angle += step
        joints.write(JointState(header(), ["fin"], [angle], [step / 0.005], []))
        wrenches.write(
            WrenchStamped(header(), Wrench(Vector3(0.0, 0.0, 0.0), Vector3(0.0, 0.0, 0.0)))
        )
        if angle > 0.05:
            (folder / "driver.json").touch()
        resting = resting + 1 if step == 0.0 and (folder / "killed").exists() else 0
        time.sleep(0.005)
    (folder / "rest.part").write_text(
        json.dumps({"angle": angle, "after_last_command": angle - heard_angle})
    )
    (folder / "rest.part").rename(folder / "rest.json")
    time.sleep(HANG_S)


def sensor_child(folder: Path) -> None:
    """A driver without ROS 2's default quality of service, which is started again after a while."""
    child = Child()
    writers = [child.writer("/wrench", WrenchStamped, OFFERS["best_effort"])]
    (folder / "child.json").write_text(json.dumps(os.getpid()))
    began = time.monotonic()
    began_ns = time.time_ns()
    for sent in itertools.count():
        # The rate and the stamps stay the same on a busy computer.
        time.sleep(max(0.0, began + sent / 50 - time.monotonic()))
        stamp = Time(*divmod(began_ns + sent * 20_000_000, 10**9))
        # Each number differs from that before, as those of a real sensor do.
        noise = 1e-4 * (sent % 7)
        force = Vector3(2.0 + noise, -1.0 + noise, 0.5 + noise)
        wrench = Wrench(force, Vector3(0.1 + noise, 0.2 + noise, 0.3 + noise))
        writers[0].write(WrenchStamped(Header(stamp, "ft"), wrench))
        if sent == 500:
            writers.append(child.writer("/wrench", WrenchStamped, OFFERS["reliable"]))


def node_child(folder: Path) -> None:
    """Reads a joint, a wrench and a command, then asks for a force and, after it, for a stop."""
    child = Child()
    readers = {
        name: child.reader(f"/fin/{name}", kind)
        for name, kind in (
            ("joint_states", JointState),
            ("wrench", WrenchStamped),
            ("command", JointState),
            ("current", Float64),
        )
    }
    readers["diagnostics"] = child.reader("/diagnostics", DiagnosticArray)
    # Sent before this process has started.
    readers["stop_reason"] = child.reader("/fin/stop_reason", String, OFFERS["latched"])
    references = child.writer("/fin/reference", WrenchStamped)
    stops = child.writer("/fin/stop", Bool)
    seen: dict[str, str] = {}
    while len(seen) < len(readers):
        for name, reader in readers.items():
            for sample in taken(reader):
                seen[name] = sample.serialize(use_version_2=False).hex()
        time.sleep(0.005)
    (folder / "seen.json").write_text(json.dumps(seen))
    while not all(
        writer.get_publication_matched_status().current_count for writer in (references, stops)
    ):
        time.sleep(0.005)
    while True:
        references.write(
            WrenchStamped(
                header("fin_mount"), Wrench(Vector3(1.5, -2.5, 0.0), Vector3(0.0, 0.0, 0.0))
            )
        )
        time.sleep(0.2)
        stops.write(Bool(True))


def stops_child(_: Path) -> None:
    """Publishes stops: once and latched before anybody listens; else again and again."""
    child = Child()
    writers = {
        name: child.writer(f"/stop/{name}", Bool, quality) for name, quality in OFFERS.items()
    }
    writers["latched"].write(Bool(True))
    references = child.writer("/stop/reference", WrenchStamped, OFFERS["best_effort"])
    while True:
        for name in ("reliable", "best_effort", "exclusive"):
            writers[name].write(Bool(True))
        references.write(
            WrenchStamped(header(), Wrench(Vector3(1.0, 1.0, 0.0), Vector3(0.0, 0.0, 0.0)))
        )
        time.sleep(0.005)


def robot_child(folder: Path) -> None:
    """Four fins that publish until they are told to stop, and somebody who asks for a wrench and,
    later, for a stop."""
    child = Child()
    names = ("front_right", "back_right", "back_left", "front_left")
    asked = (1.0, 0.5, 0.0, 0.0, 0.0, 0.1)
    joints = {name: child.writer(f"/{name}/joint_states", JointState) for name in names}
    references = {name: child.reader(f"/{name}/reference", WrenchStamped) for name in names}
    stops = {name: child.reader(f"/{name}/stop", Bool) for name in names}
    wrenches = child.writer("/robot/reference", WrenchStamped)
    stop = child.writer("/robot/stop", Bool)
    achieved = child.reader("/robot/wrench", WrenchStamped)
    saturated = child.reader("/robot/saturated", Bool)
    newest: dict[str, Any] = {}
    stopped: set[str] = set()
    is_settled = False
    while len(stopped) < len(names):
        for name in names:
            if name not in stopped:
                joints[name].write(JointState(header(), ["fin"], [0.1], [0.2], []))
            for sample in taken(references[name]):
                if not is_settled:
                    newest[name] = [sample.wrench.force.x, sample.wrench.force.y]
            if any(sample.data for sample in taken(stops[name])):
                stopped.add(name)
        wrenches.write(
            WrenchStamped(header("base_link"), Wrench(Vector3(*asked[:3]), Vector3(*asked[3:])))
        )
        for sample in taken(achieved):
            force = sample.wrench.force
            torque = sample.wrench.torque
            newest["achieved"] = [force.x, force.y, force.z, torque.x, torque.y, torque.z]
            error = max(
                abs(one - other) for one, other in zip(newest["achieved"], asked, strict=True)
            )
            is_settled = is_settled or (error < 0.002 and len(newest) == len(names) + 2)
        for sample in taken(saturated):
            newest["saturated"] = sample.data
        if is_settled:
            stop.write(Bool(True))
        time.sleep(0.01)
    (folder / "seen.json").write_text(json.dumps(newest | {"stopped": sorted(stopped)}))
    # Until the parent ends it.
    time.sleep(HANG_S)


def main(case: str, folder: Path) -> None:
    if case.endswith("_child"):
        globals()[case](folder)
        return
    # Neither is on a configuration of the user's.
    os.environ.pop("CYCLONEDDS_URI", None)
    raise_loopback()
    other = subprocess.Popen(
        [sys.executable, "-m", "tests.rig.ros2_processes", f"{case}_child", str(folder)]
    )
    try:
        told = globals()[case](folder)
        assert other.poll() is None, f"the other process ended with {other.returncode}"
    finally:
        other.kill()
        other.wait()
    (folder / "told.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
