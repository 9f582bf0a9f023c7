# ruff: noqa: E402  # without Cyclone DDS the rest cannot be imported
import json
import subprocess
import sys
import time

import numpy as np
import pytest

from softfin.core.errors import ConfigurationError, DeviceError, RigError
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import BOOL, read_joint, read_wrench
from softfin.rig.ros2.plant import open_transport
from tests import needs

needs.module("cyclonedds", "the extra ros2 is not installed")

from softfin.rig.ros2 import dds
from softfin.storage.bag.messages import FLOAT, STRING, type_store
from softfin_ros.diagnostics import DIAGNOSTICS
from tests.patience import HANG_S
from tests.rig.ros2_memory import JOINT, WRENCH, Messages
from tests.rig.ros2_processes import within

DEFINITIONS = {
    "own/msg/Part": "string name\nfloat64 value\n",
    "own/msg/Every": """
std_msgs/Header header
bool on
int8 a
float64 b
uint16 c
string<=9 bounded
byte d
char e
float32[3] three
uint8[] raw
string[] names
Part[] parts
Part[2] pair
float64[<=4] few
int64 last
""",
}


def as_idl(value, kind):
    """rosbags' message with cyclonedds' own types."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        element = kind.__metadata__[0].subtype
        return [as_idl(item, element) for item in value]
    if hasattr(value, "__msgtype__"):
        return kind(
            **{
                name: as_idl(getattr(value, name), inner)
                for name, inner in kind.__annotations__.items()
            }
        )
    return value


def messages_of(messages):
    every = messages.blank("own/msg/Every")
    yield every
    part = messages.make("own/msg/Part", "höhe", 1.5)
    full = messages.blank("own/msg/Every")
    full.header = messages.header(1_700_000_000_123_456_789, "a frame")
    full.on = True
    full.a = -7
    full.b = 1e-300
    full.c = 65535
    full.bounded = "nine"
    full.d = 127
    full.e = 255
    full.three = np.array([1, 2, 3], np.float32)
    full.raw = np.array([1, 2, 3], np.uint8)
    full.names = ["", "b", "ccc"]
    full.parts = [part, part, part]
    full.pair = [part, part]
    full.few = np.array([0.5])
    full.last = -(2**62)
    yield full
    for frame in ("", "a", "ab", "abc", "abcd", "abcdefgh"):
        yield messages.joint(1, frame, frame, 1.0, -2.0)
        yield messages.wrench(2, frame, (1.0, 2.0, 3.0, 4.0, 5.0, 6.0))
        yield messages.make(
            "geometry_msgs/msg/Vector3Stamped",
            messages.header(3, frame),
            messages.make("geometry_msgs/msg/Vector3", 1.0, 2.0, 3.0),
        )
    yield messages.blank(JOINT)
    yield messages.make(BOOL, True)


def test_cyclonedds_writes_the_same_bytes_as_rosbags():
    messages = Messages(DEFINITIONS)
    count = 0
    for message in messages_of(messages):
        kind = dds.idl_type(message.__msgtype__, messages.types)
        theirs = as_idl(message, kind).serialize(use_version_2=False)
        assert theirs == messages.encode(message), message
        count += 1
    assert count == 22


def test_names_are_ros_2s():
    kind = dds.idl_type(WRENCH, type_store(), carries=True)
    assert kind.__idl_typename__ == "geometry_msgs::msg::dds_::WrenchStamped_"
    assert kind.__annotations__["wrench"].__idl_typename__ == "geometry_msgs::msg::dds_::Wrench_"


def test_the_configuration_is_of_this_computer_alone():
    assert 'address="127.0.0.1" multicast="false"' in dds.configuration(None)
    assert "<AllowMulticast>false</AllowMulticast>" in dds.configuration(None)


@pytest.mark.real_time
def test_a_machine_of_topics_reads_moves_and_stops_a_driver_in_another_process(tmp_path):
    told = within("plant", tmp_path)
    at_rest, moved, stopped = told["angles"]
    assert set(at_rest) == {0.0}
    assert max(moved) == pytest.approx(0.5)
    assert moved[-1] == pytest.approx(0.5)
    assert sorted(moved) == moved
    # The driver braked on the stop topic, on its way to -1.
    assert -0.9 < stopped[-1] < 0.5
    assert all(
        force == pytest.approx(-0.5 * velocity, abs=1.01) for force, velocity in told["forces"]
    )
    assert not any(told["complaints"])
    assert told["counters"]["joint_refused"] == told["counters"]["wrench_refused"] == 0
    assert told["counters"]["joint_received"] > 100
    assert told["there"] == {"/joint": JOINT, "/wrench": WRENCH}
    assert "/elsewhere: no geometry_msgs/msg/WrenchStamped within 1 s; found" in told["silent"]
    assert (
        "/joint (sensor_msgs/msg/JointState), /wrench (geometry_msgs/msg/WrenchStamped)"
        in told["silent"]
    )


@pytest.mark.real_time
def test_a_force_sensor_reads_a_best_effort_driver_and_notices_a_second_publisher(tmp_path):
    told = within("sensor", tmp_path)
    assert told["wrench"] == pytest.approx([2.0, -1.0, 0.5, 0.1, 0.2, 0.3], abs=1e-3)
    assert told["described"].startswith("WrenchStamped in the frame 'ft', ")
    assert told["counters"]["sensor_malformed"] == 0
    assert told["counters"]["sensor_records"] > 20
    (line,) = told["publishers"]
    assert line.startswith("force sensor /wrench: has 2 publishers (")
    assert line.count(f" {json.loads((tmp_path / 'child.json').read_text())} on ") == 2


@pytest.mark.real_time
def test_another_process_reads_what_the_node_says_and_is_heard(tmp_path):
    told = within("node", tmp_path)
    assert told["reference"][:2] == [1.5, -2.5]
    assert told["stop"] == "emergency stop on /fin/stop"
    assert told["unsent"] == 0
    assert told["listening"] == 1
    (refusal,) = told["refusals"]
    assert refusal == (
        "/fin/stop: still requests a stop; publish false on it (latched, if the stop was), or restart "
        "the node"
    )
    messages = Messages()
    seen = {
        name: bytes.fromhex(data)
        for name, data in json.loads((tmp_path / "seen.json").read_text()).items()
    }
    joint = messages.decode(seen["joint_states"], JOINT)
    assert read_joint(joint, "fin") == (0.25, -0.5)
    wrench = messages.decode(seen["wrench"], WRENCH)
    assert read_wrench(wrench) == (1.0, 2.0, 3.0, 4.0, 5.0, 6.0)
    assert abs(joint.header.stamp.sec - time.time()) < 120
    assert read_joint(messages.decode(seen["command"], JOINT), "fin")[1] == 2.0
    assert messages.encode(wrench) == seen["wrench"]
    assert joint.effort.tolist() == [1.0], "0.5 A at 2 N m/A"
    assert messages.decode(seen["current"], FLOAT).data == 0.5
    assert messages.decode(seen["stop_reason"], STRING).data == ""
    diagnostics = messages.decode(seen["diagnostics"], DIAGNOSTICS)
    assert diagnostics.status[0].name == "fin: fin"


@pytest.mark.real_time
def test_stops_of_another_process_are_heard_best_effort_and_latched_from_before_too(tmp_path):
    told = within("stops", tmp_path)
    assert told["heard"] == {
        "reliable": "emergency stop on /stop/reliable",
        "best_effort": "emergency stop on /stop/best_effort",
        "latched": "emergency stop on /stop/latched",
        "exclusive": None,
    }
    assert sorted(line.partition(";")[0] for line in told["told"]) == [
        "/stop/exclusive: messages from a publisher cannot be received, so it cannot stop the fin",
        "/stop/reference: messages from a publisher cannot be received",
    ]


@pytest.mark.real_time
def test_a_driver_stops_by_itself_where_softfin_is_killed(tmp_path):
    told = within("dead_man", tmp_path)
    # At 0.1 rad/s, 0.2 s after the last command; it was on its way to 1.5 rad.
    assert 0.0 <= told["after_last_command"] < 0.021
    assert 0.05 < told["angle"] < 1.4


FORKS = """
import json, os, sys
from softfin.core.errors import SoftfinError
from softfin.storage.bag.messages import type_store
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.dds import DdsTransport, configuration

KIND = "std_msgs/msg/Bool"


def opened(**options):
    try:
        return DdsTransport(TransportConfig(domain=231, **options), type_store())
    except SoftfinError as error:
        print(type(error).__name__, error)


os.environ.pop("CYCLONEDDS_URI", None)
for code in json.load(sys.stdin):
    sys.stdout.flush()
    if not os.fork():
        exec(code)
        sys.stdout.flush()
        os._exit(0)
    assert os.wait()[1] == 0
    print("--")
"""
"""Runs each code in a process of its own, because Cyclone DDS reads its environment once."""

CODES = {
    "left": """
first = opened()
second = opened()
print(first.notes)
first.close()
first.close()
publisher = second.publish("/fin/x", KIND)
print(second.topics(), publisher.readers())
second.close()
del publisher
opened(network="no-such")
""",
    "publishers": f"""
import time
ours = opened()
theirs = opened()
own = ours.publish("/x", KIND)
def wait(count):
    end = time.monotonic() + {HANG_S}
    while len(ours.publishers("/x")) != count and time.monotonic() < end:
        time.sleep(0.01)
    return [f" {{os.getpid()}} on " in name for name in ours.publishers("/x")]
print(wait(0))
first = theirs.publish("/x", KIND)
second = theirs.publish("/x", KIND)
elsewhere = theirs.publish("/y", KIND)
print(wait(2))
del first
print(wait(1))
theirs.close()
del second, elsewhere
print(wait(0))
ours.close()
print(ours.publishers("/x"))
""",
    "two networks": 'first = opened()\nopened(network="lo")',
    "own network": 'print(opened(network="lo").notes)',
    "own configuration": """
os.environ["CYCLONEDDS_URI"] = configuration(None)
print(opened().notes, opened(network="eth7").notes)
os.environ["CYCLONEDDS_URI"] = "file:///no/such"
""",
    "closed": """
way = opened()
way.close()
try:
    way.publish("/x", KIND)
except SoftfinError as error:
    print(type(error).__name__, error)
""",
}


@pytest.fixture(scope="module")
def said():
    """What each of CODES printed."""
    done = subprocess.run(
        [sys.executable, "-c", FORKS],
        input=json.dumps(list(CODES.values())),
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr
    return dict(zip(CODES, done.stdout.split("\n--\n"), strict=False))


def test_a_process_that_opens_and_closes_leaves_its_domain(said):
    lines = said["left"].splitlines()
    assert lines[:2] == ["()", "{} 0"]
    assert lines[2].startswith("DeviceError DDS domain 231 cannot be used")
    assert "make sure that the network interface (no-such) exists and is up" in lines[2]


def test_the_publishers_of_other_nodes_are_named_until_they_leave(said):
    assert said["publishers"].splitlines() == ["[]", "[True, True]", "[True]", "[]", "[]"]


def test_one_domain_cannot_be_on_two_networks(said):
    told = said["two networks"]
    assert told.startswith("DeviceError DDS domain 231 cannot be used")
    assert told.endswith("and that this program does not use another interface for this domain")


def test_a_network_of_ones_own_comes_with_a_warning(said):
    assert said["own network"] == (
        "('everyone on the network of lo can read and write these topics',)"
    )


def test_a_users_own_configuration_of_dds_stands(said):
    assert said["own configuration"] == (
        "('DDS is configured by CYCLONEDDS_URI',) ('DDS is configured by CYCLONEDDS_URI, so --network eth7 "
        "is ignored',)"
    )


def test_a_closed_way_is_told_and_nothing_hangs(said):
    assert said["closed"] == (
        f"{DeviceError.__name__} the connection to ROS 2 is closed; open it again"
    )


@pytest.mark.parametrize("text", ["-1", "233", "abc"])
def test_a_domain_that_is_none_is_told(monkeypatch, text):
    monkeypatch.setenv("ROS_DOMAIN_ID", text)
    with pytest.raises(RigError, match="must be an integer from 0 to 232"):
        TransportConfig().domain_id()
    with pytest.raises(ConfigurationError, match="domain"):
        TransportConfig.build({"domain": text})


def test_rclpy_is_asked_for_only_where_it_is(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(
        RigError,
        match="rclpy is not installed in this Python environment; source the ROS 2 setup file",
    ):
        open_transport(TransportConfig(transport="rclpy"))


def test_without_cyclonedds_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "cyclonedds", None)
    monkeypatch.delitem(sys.modules, "softfin.rig.ros2.dds")
    for name in [name for name in sys.modules if name.startswith("cyclonedds.")]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(RigError, match=r"need cyclonedds: .*pip install .*\[ros2\]"):
        open_transport(TransportConfig(transport="dds"))
