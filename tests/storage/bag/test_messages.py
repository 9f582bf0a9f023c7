import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some
from rosbags.typesys import Stores, get_typestore

from softfin.storage.bag.messages import COMMAND, CURRENT, EVENTS, JOINT, REFERENCE, TYPES, WRENCH, Row, cdr

STORE = get_typestore(Stores.ROS2_HUMBLE)


def by_rosbags(row: Row) -> bytes:
    """What the general serialiser makes of a row."""
    types = STORE.types
    kind = TYPES[row.topic]
    time = types["builtin_interfaces/msg/Time"](*divmod(row.stamp_ns, 10**9))
    header = types["std_msgs/msg/Header"](time, "fin")
    if kind == "std_msgs/msg/String":
        message = types[kind](row.values)
    elif kind == "std_msgs/msg/Float64":
        message = types[kind](row.values[0])
    elif kind == "sensor_msgs/msg/JointState":
        message = types[kind](header, ["fin"], *(np.array([value]) for value in row.values), np.zeros(0))
    else:
        vector = types["geometry_msgs/msg/Vector3"]
        message = types[kind](
            header, types["geometry_msgs/msg/Wrench"](vector(*row.values[:3]), vector(*row.values[3:]))
        )
    return bytes(STORE.serialize_cdr(message, kind))


NUMBERS = some.floats(allow_nan=True, allow_infinity=True)


@pytest.mark.parametrize(("topic", "count"), [(COMMAND, 2), (JOINT, 2), (WRENCH, 6), (REFERENCE, 6), (CURRENT, 1)])
@given(data=some.data())
def test_numbers_are_packed_as_another_serialiser_packs_them(topic, count, data):
    values = data.draw(some.tuples(*[NUMBERS] * count))
    row = Row(topic, data.draw(some.integers(0, 2**31 * 10**9 - 1)), values)
    assert cdr(row) == by_rosbags(row)


@given(text=some.text(some.characters(exclude_characters="\0", exclude_categories=["Cs"])))
def test_texts_are_packed_as_another_serialiser_packs_them(text):
    assert cdr(Row(EVENTS, 0, text)) == by_rosbags(Row(EVENTS, 0, text))
