"""Topics in simulated time."""

from softfin.emulation.clock import SimulatedClock
from softfin.rig.ros2.connection import BOOL, Transport
from tests.rig.simulated_topics import SimulatedTransport


def test_messages_reach_the_readers_of_their_topic_and_type_until_the_publisher_leaves():
    clock = SimulatedClock()
    ours = SimulatedTransport(clock)
    theirs = SimulatedTransport(clock)
    assert isinstance(ours, Transport)
    publisher = theirs.publish("/stop", BOOL)
    reader = ours.subscribe("/stop", BOOL, depth=2)
    others = [
        ours.subscribe("/stop", "geometry_msgs/msg/Vector3Stamped"),
        ours.subscribe("/go", BOOL),
    ]
    assert publisher.readers() == 1
    assert ours.topics() == {"/stop": BOOL}
    assert theirs.topics() == {}
    for data in (b"1", b"2", b"3"):
        clock.sleep(1.0)
        publisher.send(data)
    assert reader.take() == [(b"2", clock() - 1.0), (b"3", clock())]
    assert reader.take() == []
    assert [len(other.take()) for other in others] == [0, 0]
    assert len(reader.publishers()) == 1
    assert ours.publishers("/stop") == [theirs._name]
    assert theirs.publishers("/stop") == ours.publishers("/go") == []
    theirs.close()
    publisher.send(b"4")
    assert reader.take() == []
    assert reader.publishers() == ours.publishers("/stop") == []
    theirs.close()
    ours.close()
