"""ROS 2 topics without ROS 2: plain DDS with the names, types and quality of service of ROS 2; by
default only on this computer.

Names follow the ROS 2 design article "Topic and Service name mapping to DDS": ``/fin/wrench`` is
the topic ``rt/fin/wrench``, and ``geometry_msgs/msg/Wrench`` is the type
``geometry_msgs::msg::dds_::Wrench_``. Tested only between softfin processes on loopback, not yet
with a ROS 2 node.
"""

import functools
import os
import time
from typing import Any
from uuid import UUID

from rosbags.interfaces import Nodetype
from rosbags.typesys.store import Typestore

from softfin.core.errors import DeviceError, RigError, one_line
from softfin.installation import how_to_add
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import DEPTH, Publisher, Quality, Subscriber

try:
    from cyclonedds.builtin import (
        BuiltinDataReader,
        BuiltinTopicDcpsParticipant,
        BuiltinTopicDcpsPublication,
    )
    from cyclonedds.core import DDSException
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.idl import IdlStruct, make_idl_struct, types
    from cyclonedds.internal import InvalidSample
    from cyclonedds.pub import DataWriter
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError:
    raise RigError(
        f"topics without a ROS 2 installation need cyclonedds: {how_to_add('ros2')}"
    ) from None

URI = "CYCLONEDDS_URI"

# Type checkers do not understand the brackets that contain the lengths of these types.
IDL: Any = types

BASES = {"byte": types.byte, "char": types.uint8, "string": str, "bool": bool}
"""ROS 2 types with different names in IDL."""

PROCESS = {"__ProcessName", "__Pid", "__Hostname"}
"""Properties in which Cyclone DDS describes its process."""

# A slow reader may block a writer for at most half a tick [ns].
RELIABLE = Policy.Reliability.Reliable(5_000_000)

# ROS 2 uses version 1 of CDR; otherwise, cyclonedds would also offer version 2.
REPRESENTATION = Policy.DataRepresentation(
    use_cdrv0_representation=True, use_xcdrv2_representation=False
)


class Carrier(IdlStruct):
    """Raw bytes as sent over the network: softfin's messages are already CDR, and received messages
    are decoded elsewhere."""

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
    """Return the DDS type of a message; if `carries` is set, the samples contain CDR instead of
    fields."""
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
    """Return the Cyclone DDS configuration for a network interface; None restricts DDS to this
    computer (loopback without multicast)."""
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
    """Transport over Cyclone DDS."""

    def __init__(self, config: TransportConfig, typestore: Typestore) -> None:
        """`typestore` must contain the types of all messages."""
        self._types = typestore
        number = config.domain_id()
        network = config.network
        self.notes: tuple[str, ...] = ()
        try:
            if os.environ.get(URI):
                ignored = "" if network is None else f", so --network {network} is ignored"
                self.notes = (f"DDS is configured by {URI}{ignored}",)
            else:
                _open_domain(number, network)
                if network is not None:
                    self.notes = (
                        f"everyone on the network of {network} can read and write these topics",
                    )
            self._participant: Any = DomainParticipant(number)
        except DDSException as error:
            raise DeviceError(
                f"DDS domain {number} cannot be used ({one_line(error)}); check {URI}, and make "
                f"sure that the network interface ({network or 'loopback'}) exists and is up, and "
                "that this program does not use another interface for this domain"
            ) from None
        self._own: set[str] = set()
        self._publications: Any = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        self._others: dict[UUID, Any] = {}
        """Publishers of other nodes, by key."""

    def publish(
        self, topic: str, kind: str, deadline_s: float | None = None, latched: bool = False
    ) -> Publisher:
        """Create a writer."""
        there = self._topic(topic, kind)
        writer: Any = DataWriter(self._participant, there, qos=_offered(deadline_s, latched))
        self._own.add(str(writer.get_guid()))

        def send(data: bytes) -> None:
            try:
                writer.write(there.data_type(data))
            except DDSException as error:
                raise DeviceError(
                    f"{topic}: message not sent ({one_line(error)}); check whether its reader is "
                    "too slow"
                ) from None

        return Publisher(send, lambda: int(writer.get_publication_matched_status().current_count))

    def subscribe(
        self, topic: str, kind: str, quality: Quality = "reliable", depth: int = DEPTH
    ) -> Subscriber:
        """Create a reader that keeps the latest messages."""
        reader: Any = DataReader(
            self._participant, self._topic(topic, kind), qos=_asked(quality, depth)
        )
        participant = self._participant
        names: dict[int, str] = {}

        def take() -> list[tuple[bytes, float]]:
            try:
                found = reader.take(depth)
            except DDSException as error:
                raise DeviceError(
                    f"{topic}: cannot be read ({one_line(error)}); start softfin again"
                ) from None
            now = time.monotonic()
            return [(sample.data, now) for sample in found if not isinstance(sample, InvalidSample)]

        def publishers() -> list[str]:
            handles = reader.get_matched_publications()
            for handle in handles:
                endpoint = None
                if handle not in names:
                    endpoint = reader.get_matched_publication_data(handle)
                # A publisher may leave at any time.
                if endpoint is not None:
                    names[handle] = _name_participant(participant, endpoint.participant_key)
            return [names[handle] for handle in handles if handle in names]

        return Subscriber(
            take,
            lambda: int(reader.get_requested_incompatible_qos_status().total_count),
            publishers,
        )

    def topics(self) -> dict[str, str]:
        """Return the topics published by other nodes, with their types, from DDS discovery."""
        topics = []
        for publication in self._discover():
            # ROS 2 adds the prefix "rt" to topic names.
            if publication.topic_name.startswith("rt/"):
                kind = publication.type_name.replace("::dds_::", "::").removesuffix("_")
                topics.append((publication.topic_name[2:], kind.replace("::", "/")))
        return dict(sorted(topics))

    def publishers(self, topic: str) -> list[str]:
        """Return the sorted processes of other nodes that publish on a topic."""
        return sorted(
            _name_participant(self._participant, publication.participant_key)
            for publication in self._discover()
            if publication.topic_name == f"rt{topic}"
        )

    def _discover(self) -> list[Any]:
        """Return the current publishers of other nodes."""
        if self._participant is None:
            return []
        for publication in self._publications.take(1000):
            # Other fields are empty if the publisher has left.
            if not publication.sample_info.valid_data:
                self._others.pop(publication.key, None)
            elif str(publication.key) not in self._own:
                self._others[publication.key] = publication
        return list(self._others.values())

    def close(self) -> None:
        """Release the participant; readers and writers that are still in use are closed with their
        last reference."""
        self._participant = self._publications = None

    def _topic(self, topic: str, kind: str) -> Any:
        if self._participant is None:
            raise DeviceError("the connection to ROS 2 is closed; open it again")
        return Topic(
            self._participant,
            f"rt{topic}",
            idl_type(kind, self._types, carries=True),
            qos=_asked("reliable", DEPTH),
        )


def _name_participant(participant: DomainParticipant, key: UUID) -> str:
    """Return the process of a different participant, or its DDS number if it does not send its
    process. Only Cyclone DDS sends processes, and DDS does not contain the names of ROS 2 nodes."""
    values: dict[str, str] = {}
    for other in BuiltinDataReader(participant, BuiltinTopicDcpsParticipant).take(1000):
        if other.key == key and other.sample_info.valid_data:
            properties = [item for item in other.qos if isinstance(item, Policy.Property)]
            values = {item.key: item.value for item in properties}
    if not values.keys() >= PROCESS:
        return f"DDS participant {key}"
    return "{__ProcessName} {__Pid} on {__Hostname}".format_map(values)


def _asked(quality: Quality, depth: int) -> Qos:
    """Return the quality of service for a reader."""
    return Qos(
        Policy.Reliability.BestEffort if quality == "best_effort" else RELIABLE,
        Policy.History.KeepLast(depth),
        Policy.Durability.TransientLocal if quality == "latched" else Policy.Durability.Volatile,
        REPRESENTATION,
    )


def _offered(deadline_s: float | None, latched: bool) -> Qos:
    """Return the quality of service for a writer."""
    if latched:
        return _asked("latched", 1)
    policies = _asked("reliable", DEPTH)
    if deadline_s is None:
        return policies
    deadline_ns = round(deadline_s * 1e9)
    # Manual by topic, so that only messages assert liveliness: softfin must not seem alive when it
    # hangs while its middleware runs.
    liveliness = Policy.Liveliness.ManualByTopic(deadline_ns)
    return Qos(Policy.Deadline(deadline_ns), liveliness, base=policies)


@functools.cache
def _open_domain(number: int, network: str | None) -> object:
    """Open a DDS domain with our configuration; cached because the entire process must share it."""
    return Domain(number, configuration(network))
