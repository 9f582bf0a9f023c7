import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import RigError
from softfin.rig.ros2.messages import (
    BOOL,
    JOINT,
    VECTOR,
    WRENCH,
    Messages,
    joint_of,
    reference_of,
    stamp_of,
    type_name,
    wrench_of,
)

MESSAGES = Messages()
numbers = st.floats(allow_nan=False, allow_infinity=False)


@given(numbers, numbers, st.integers(1, 2**31 * 10**9 - 1), st.text(max_size=5))
def test_a_joint_comes_back_as_it_went(angle, velocity, stamp, frame):
    frame = frame.replace("\0", "")
    message = MESSAGES.decode(MESSAGES.encode(MESSAGES.joint(stamp, frame, "fin", angle, velocity)), JOINT)
    assert joint_of(message, "fin") == (angle, velocity)
    assert stamp_of(message) == stamp
    assert message.header.frame_id == frame


@given(st.tuples(*[numbers] * 6))
def test_a_wrench_comes_back_as_it_went(wrench):
    message = MESSAGES.decode(MESSAGES.encode(MESSAGES.wrench(1, "", wrench)), WRENCH)
    assert wrench_of(message) == wrench


@given(st.binary(max_size=300), st.sampled_from([JOINT, WRENCH, VECTOR, BOOL]))
def test_any_bytes_are_a_message_or_refused(data, kind):
    told = kind
    try:
        MESSAGES.decode(data, kind)
    except ValueError as error:
        told = str(error)
    assert kind in told
    assert "\n" not in told


def test_a_joint_among_others_is_found_by_its_name():
    message = MESSAGES.joint(1, "", "fin", 1.0, 2.0)
    message.name, message.position, message.velocity = ["a", "fin"], np.array([0.0, 3.0]), np.zeros(0)
    assert joint_of(message, "fin") == (3.0, None)
    with pytest.raises(ValueError, match=r"no joint 'tail' in it; it has 'a', 'fin'"):
        joint_of(message, "tail")
    message.position = np.zeros(1)
    with pytest.raises(ValueError, match="2 names, 1 positions"):
        joint_of(message, "fin")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_what_is_no_number_is_refused(bad):
    with pytest.raises(ValueError, match="velocity is"):
        joint_of(MESSAGES.joint(1, "", "fin", 0.0, bad), "fin")
    for index in range(6):
        wrench = [0.0] * 6
        wrench[index] = bad
        with pytest.raises(ValueError, match=r"(force|torque) [xyz] is"):
            wrench_of(MESSAGES.wrench(1, "", tuple(wrench)))
    with pytest.raises(ValueError, match="y is"):
        reference_of(MESSAGES.wrench(1, "", (0.0, bad, 0.0, 0.0, 0.0, 0.0)), "fin_mount")


def test_references_are_of_both_types_and_of_our_frame():
    wrench = MESSAGES.wrench(1, "fin_mount", (1.0, -2.0, 9.0, 9.0, 9.0, 9.0))
    vector = MESSAGES.make(VECTOR, MESSAGES.header(1, ""), MESSAGES.make("geometry_msgs/msg/Vector3", 3.0, 4.0, 0.0))
    assert reference_of(wrench, "fin_mount") == (1.0, -2.0)
    assert reference_of(vector, "fin_mount") == (3.0, 4.0)
    with pytest.raises(ValueError, match="in the frame 'fin_mount'; this node's is 'base'"):
        reference_of(wrench, "base")


def test_a_definition_of_ones_own_makes_blank_messages():
    whole = "std_msgs/Header header\nPart[2] parts\nfloat64[3] b\nint8[] c\nstring d"
    messages = Messages({"own/msg/Part": "float32 a\nbool on\n", "own/msg/Whole": whole})
    blank = messages.blank("own/msg/Whole")
    assert [part.a for part in blank.parts] == [0, 0]
    assert blank.b.tolist() == [0, 0, 0]
    assert messages.decode(messages.encode(blank), "own/msg/Whole").d == ""


@pytest.mark.parametrize("text", ["float65 a", "float64", "Part[] missing", "wstring wide", "Bad[] itself", ""])
def test_a_definition_that_is_none_is_told_in_one_line(text):
    with pytest.raises(RigError, match=r"message own/msg/Bad: its definition cannot be used .*\.msg") as error:
        Messages({"own/msg/Bad": text}) if text else Messages({"own/msg/Bad": "= 3"})
    assert "\n" not in str(error.value)


def test_type_names_are_written_in_full():
    assert type_name("sensor_msgs/JointState") == JOINT
    with pytest.raises(ValueError, match="is not a message type"):
        type_name("JointState")
