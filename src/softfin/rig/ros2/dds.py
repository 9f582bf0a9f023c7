"""ROS 2's topics without ROS 2: over DDS, with its names, types and quality of service; on this
computer alone.

Names after ROS 2's design article "Topic and Service name mapping to DDS": ``/fin/wrench`` is the
topic ``rt/fin/wrench``, ``geometry_msgs/msg/Wrench`` the type
``geometry_msgs::msg::dds_::Wrench_``. Tried between processes of this library on loopback only: it
has not met a node of ROS 2.
"""

import functools
import os
import time
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from softfin.core.errors import DeviceError, RigError, one_line
from softfin.installation import how_to_add
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import DEPTH, Publisher, Quality, Subscriber

try:
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import IdlStruct, make_idl_struct, types
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError:
    raise RigError(f"ROS 2's topics without ROS 2 need cyclonedds: {how_to_add('ros2')}") from None

URI = "CYCLONEDDS_URI"

# Its types take their lengths in brackets, in a way of their own that type checkers do not know.
IDL: Any = types

BASES = {"byte": types.int8, "char": types.uint8, "string": str, "bool": bool}
"""Types that have other names there."""

# A slow reader may hold up a writer for half a tick [ns].
RELIABLE = Policy.Reliability.Reliable(5_000_000)

# ROS 2 speaks the first version of CDR; cyclonedds would offer the second one too.
REPRESENTATION = Policy.DataRepresentation(
    use_cdrv0_representation=True, use_xcdrv2_representation=False
)


class Carrier(IdlStruct):
    """Bytes as they go over the wire: softfin's messages are CDR already, and what comes is decoded
    elsewhere."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, *_: object, **__: object) -> bytes:
        """The bytes as they are."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, *_: object, **__: object) -> "Carrier":
        """The bytes as they are."""
        return cls(bytes(data))

    deserialize_key = deserialize


def idl_type(kind: str, typestore: Typestore, carries: bool = False) -> Any:
    """The DDS type of a message; with `carries` its samples hold CDR in place of fields."""
    fields = {
        name: _idl_field(descriptor, typestore) for name, descriptor in typestore.fielddefs[kind][1]
    }
    package, _, name = kind.split("/")
    bases = (Carrier,) if carries else ()
    return make_idl_struct(
        f"{name}_", f"{package}::msg::dds_::{name}_", fields, dataclassify=not carries, bases=bases
    )


def _idl_field(descriptor: Any, typestore: Typestore) -> Any:
    node, detail = descriptor
    if node is Nodetype.NAME:
        return idl_type(detail, typestore)
    if node is Nodetype.BASE:
        name, bound = detail
        return (
            IDL.bounded_str[bound]
            if name == "string" and bound
            else BASES.get(name) or getattr(types, name)
        )
    element, count = detail
    inner = _idl_field(element, typestore)
    if node is Nodetype.ARRAY:
        return IDL.array[inner, count]
    return IDL.sequence[inner, count] if count else IDL.sequence[inner]


def configuration(network: str | None) -> str:
    """Cyclone DDS's configuration for a network interface; None is this computer alone: loopback,
    no multicast."""
    if network is not None:
        inner = f'<General><Interfaces><NetworkInterface name="{network}"/></Interfaces></General>'
    else:
        inner = (
            '<General><Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/>'
            "</Interfaces>"
            "<AllowMulticast>false</AllowMulticast></General>"
            "<Discovery><ParticipantIndex>auto</ParticipantIndex>"
            '<Peers><Peer address="127.0.0.1"/></Peers></Discovery>'
        )
    return f'<CycloneDDS><Domain Id="any">{inner}</Domain></CycloneDDS>'


class DdsTransport:
    """Meets the Transport contract."""

    def __init__(self, config: TransportConfig, typestore: Typestore) -> None:
        """`typestore` has the types of all messages."""
        self._types = typestore
        number = config.domain_id()
        network = config.network
        self.notes: tuple[str, ...] = ()
        try:
            if os.environ.get(URI):
                ignored = "" if network is None else f": --network {network} does not count"
                self.notes = (f"DDS is set up by {URI}{ignored}",)
            else:
                _open_domain(number, network)
                if network is not None:
                    self.notes = (
                        f"everybody on the network of {network} can read these topics and write to "
                        "them",
                    )
            self._participant: Any = DomainParticipant(number)
        except DDSException as error:
            raise DeviceError(
                f"DDS domain {number} cannot be used ({one_line(error)}); check {URI}, that the "
                f"network interface ({network or 'loopback'}) is there and up, and that no other "
                "one was given for this domain"
            ) from None
        self._own: set[str] = set()

    def publish(self, topic: str, kind: str, deadline_s: float | None = None) -> Publisher:
        """A writer of its own."""
        there = self._topic(topic, kind)
        writer: Any = DataWriter(self._participant, there, qos=_offered(deadline_s))
        self._own.add(str(writer.get_guid()))

        def send(data: bytes) -> None:
            try:
                writer.write(there.data_type(data))
            except DDSException as error:
                raise DeviceError(
                    f"{topic}: not sent ({one_line(error)}); is its reader too slow?"
                ) from None

        return Publisher(send, lambda: int(writer.get_publication_matched_status().current_count))

    def subscribe(self, topic: str, kind: str, quality: Quality = "reliable") -> Subscriber:
        """A reader of its own, which keeps the last messages."""
        reader: Any = DataReader(self._participant, self._topic(topic, kind), qos=_asked(quality))

        def take() -> list[tuple[bytes, float]]:
            try:
                found = reader.take(DEPTH)
            except DDSException as error:
                raise DeviceError(
                    f"{topic}: cannot be read ({one_line(error)}); start again"
                ) from None
            now = time.monotonic()
            return [(sample.data, now) for sample in found if not isinstance(sample, InvalidSample)]

        return Subscriber(
            take, lambda: int(reader.get_requested_incompatible_qos_status().total_count)
        )

    def topics(self) -> dict[str, str]:
        """Topics that other nodes publish, from DDS's own discovery."""
        if self._participant is None:
            return {}
        found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication).take(1000)
        there = [
            one for one in found if str(one.key) not in self._own and one.sample_info.valid_data
        ]
        kinds = [
            one.type_name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")
            for one in there
        ]
        pairs = zip((one.topic_name for one in there), kinds, strict=True)
        return dict(sorted((name[2:], kind) for name, kind in pairs if name.startswith("rt/")))

    def close(self) -> None:
        """Leave; readers and writers that somebody still holds go with the last one who does."""
        self._participant = None

    def _topic(self, topic: str, kind: str) -> Any:
        if self._participant is None:
            raise DeviceError("the connection to ROS 2 is closed; open it again")
        return Topic(
            self._participant,
            f"rt{topic}",
            idl_type(kind, self._types, carries=True),
            qos=_asked("reliable"),
        )


def _asked(quality: Quality) -> Any:
    """Quality of service of a reader."""
    return Qos(
        Policy.Reliability.BestEffort if quality == "best_effort" else RELIABLE,
        Policy.History.KeepLast(DEPTH),
        Policy.Durability.TransientLocal if quality == "latched" else Policy.Durability.Volatile,
        REPRESENTATION,
    )


def _offered(deadline_s: float | None) -> Any:
    """Quality of service of a writer."""
    policies = [
        RELIABLE,
        Policy.History.KeepLast(DEPTH),
        Policy.Durability.Volatile,
        REPRESENTATION,
    ]
    if deadline_s is not None:
        deadline_ns = round(deadline_s * 1e9)
        # By topic: only messages keep it alive. A softfin that hangs must not look alive because
        # its middleware is.
        policies += [Policy.Deadline(deadline_ns), Policy.Liveliness.ManualByTopic(deadline_ns)]
    return Qos(*policies)


@functools.cache
def _open_domain(number: int, network: str | None) -> Any:
    """The DDS domain with our configuration, shared by the whole process."""
    return Domain(number, configuration(network))
