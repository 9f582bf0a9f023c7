import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from rosbags.typesys import Stores, get_typestore

from softfin.storage.bag.messages import FLOAT, JOINT_STATE, STRING, WRENCH_STAMPED, cdr

STORE = get_typestore(Stores.ROS2_HUMBLE)


def by_rosbags(kind: str, stamp_ns: int, values, frame: str, joint: str) -> bytes:
    """What the general serialiser makes of a message."""
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
    header = types["std_msgs/msg/Header"](time, frame)
    if kind == STRING:
        message = types[kind](values)
    elif kind == FLOAT:
        message = types[kind](values[0])
    elif kind == JOINT_STATE:
        message = types[kind](
            header, [joint], *(np.array([value]) for value in values), np.zeros(0)
        )
    else:
        vector = types["geometry_msgs/msg/Vector3"]
        message = types[kind](
            header, types["geometry_msgs/msg/Wrench"](vector(*values[:3]), vector(*values[3:]))
        )
    return bytes(STORE.serialize_cdr(message, kind))


NUMBERS = some.floats(allow_nan=True, allow_infinity=True)
NAMES = some.sampled_from(["fin", "", "fin_mount", "tail_joint", "höhe"])


@pytest.mark.parametrize(("kind", "count"), [(JOINT_STATE, 2), (WRENCH_STAMPED, 6), (FLOAT, 1)])
@given(data=some.data(), frame=NAMES, joint=NAMES)
def test_numbers_are_packed_as_another_serialiser_packs_them(kind, count, data, frame, joint):
    values = data.draw(some.tuples(*[NUMBERS] * count))
    stamp = data.draw(some.integers(0, 2**31 * 10**9 - 1))
    assert cdr(kind, stamp, values, frame, joint) == by_rosbags(kind, stamp, values, frame, joint)


@given(text=some.text(some.characters(exclude_characters="\0", exclude_categories=["Cs"])))
def test_texts_are_packed_as_another_serialiser_packs_them(text):
    assert cdr(STRING, 0, text) == by_rosbags(STRING, 0, text, "", "")


@pytest.mark.parametrize("count", [1, 4])
def test_another_number_of_values_is_refused(count):
    with pytest.raises(ValueError, match="argument"):
        cdr(JOINT_STATE, 0, (1.0,) * count)
