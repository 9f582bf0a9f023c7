"""ROS 2's topics without ROS 2: over DDS, with its names, types and quality of service; on this computer alone.

Names after ROS 2's design article "Topic and Service name mapping to DDS": ``/fin/wrench`` is the topic
``rt/fin/wrench``, ``geometry_msgs/msg/Wrench`` the type ``geometry_msgs::msg::dds_::Wrench_``. Tried between processes
of this library on loopback only: it has not met a node of ROS 2.
"""

import contextlib
import os
import threading
import time
import weakref
from typing import Any
from xml.sax.saxutils import quoteattr

from rosbags.interfaces import Nodetype

from softfin.core.errors import DeviceError, RigError
from softfin.rig.ros2.messages import Messages
from softfin.rig.ros2.transport import DEPTH, Received, TransportConfig

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
    raise RigError("ROS 2's topics without ROS 2 need cyclonedds; install it: pip install softfin[ros2]") from None

URI = "CYCLONEDDS_URI"

BLOCK_NS = 5_000_000
"""Longest that a slow reader may hold up a writer [ns]: half a tick."""

IDL: Any = types
"""Its types take their lengths in brackets, in a way of their own that type checkers do not know."""

BASES = {"byte": types.int8, "char": types.uint8, "string": str, "bool": bool} | {
    name: getattr(types, name)
    for name in ("int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
}

_domains: "weakref.WeakValueDictionary[int, Any]" = weakref.WeakValueDictionary()
_networks: dict[int, str | None] = {}
_lock = threading.Lock()


class Carrier(IdlStruct):
    """Bytes as they go over the wire: softfin's messages are CDR already, and what comes is decoded elsewhere."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def serialize(self, *_: Any, **__: Any) -> bytes:
        """As they are."""
        return self.data

    @classmethod
    def deserialize(cls, data: bytes, *_: Any, **__: Any) -> "Carrier":
        """As they are."""
        return cls(bytes(data))

    deserialize_key = deserialize


def idl_type(kind: str, messages: Messages, carries: bool = False) -> Any:
    """The DDS type of a message; `carries`: its samples hold CDR in place of fields."""
    fields = {name: _idl_field(descriptor, messages) for name, descriptor in messages.types.fielddefs[kind][1]}
    package, _, name = kind.split("/")
    bases = (Carrier,) if carries else ()
    return make_idl_struct(f"{name}_", f"{package}::msg::dds_::{name}_", fields, dataclassify=not carries, bases=bases)


def dds_topic(topic: str) -> str:
    """ROS 2's name of a topic on the wire."""
    return f"rt{topic}"


def localhost() -> str:
    """Cyclone DDS's configuration for this computer alone: loopback, no multicast."""
    return _configuration(
        '<NetworkInterface address="127.0.0.1" multicast="false"/>',
        "<AllowMulticast>false</AllowMulticast>",
        '<Discovery><ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers></Discovery>',
    )


class DdsTransport:
    """Meets the Transport contract."""

    def __init__(self, config: TransportConfig, messages: Messages) -> None:
        self._messages = messages
        self._domain, self.notes = _open_domain(config)
        try:
            self._participant: Any = DomainParticipant(config.domain_id())
            self._publications: Any = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        except DDSException as error:
            self._domain = None
            raise DeviceError(f"DDS cannot be used ({_reason(error)}); {_way_out(config)}") from None
        self._own: set[str] = set()
        self._seen: dict[str, tuple[str, str]] = {}

    def publish(self, topic: str, kind: str) -> "DdsOutlet":
        """A writer of its own."""
        return DdsOutlet(self._open(), self._carrier(topic, kind), topic, self._own)

    def subscribe(self, topic: str, kind: str, best_effort: bool = False) -> "DdsInlet":
        """A reader of its own."""
        return DdsInlet(self._open(), self._carrier(topic, kind), topic, best_effort)

    def topics(self) -> dict[str, str]:
        """From DDS's own discovery."""
        if self._publications is None:
            return {}
        for found in self._publications.take(1000):
            key = str(found.key)
            gone = found.sample_info is not None and not found.sample_info.valid_data
            if gone:
                self._seen.pop(key, None)
            elif str(found.topic_name).startswith("rt/"):
                self._seen[key] = (found.topic_name[2:], _ros_type(found.type_name))
        return dict(sorted(pair for key, pair in self._seen.items() if key not in self._own))

    def close(self) -> None:
        """Readers and writers that somebody still holds go with the last one who does."""
        with contextlib.suppress(Exception):
            self._publications = self._participant = self._domain = None

    def _open(self) -> Any:
        if self._participant is None:
            raise DeviceError("the way to ROS 2 is closed; open it again")
        return self._participant

    def _carrier(self, topic: str, kind: str) -> tuple[str, Any]:
        return dds_topic(topic), idl_type(kind, self._messages, carries=True)


class DdsOutlet:
    """Meets the Outlet contract."""

    def __init__(self, participant: Any, carrier: tuple[str, Any], name: str, own: set[str]) -> None:
        quality = _quality()
        self._name, (topic, self._carrier) = name, carrier
        self._writer = DataWriter(participant, Topic(participant, topic, self._carrier, qos=quality), qos=quality)
        own.add(str(self._writer.get_guid()))

    def send(self, data: bytes) -> None:
        """Written to the network before it returns."""
        try:
            self._writer.write(self._carrier(data))
        except DDSException as error:
            raise DeviceError(f"{self._name}: not sent ({_reason(error)}); is its reader too slow?") from None

    def listeners(self) -> int:
        """Matched readers."""
        return int(self._writer.get_publication_matched_status().current_count)  # type: ignore[no-untyped-call]


class DdsInlet:
    """Meets the Inlet contract."""

    def __init__(self, participant: Any, carrier: tuple[str, Any], name: str, best_effort: bool) -> None:
        quality = _quality(best_effort)
        self._name, (topic, kind) = name, carrier
        self._reader = DataReader(participant, Topic(participant, topic, kind, qos=_quality()), qos=quality)

    def take(self) -> list[Received]:
        """All that DDS has kept."""
        try:
            found = self._reader.take(DEPTH)
        except DDSException as error:
            raise DeviceError(f"{self._name}: cannot be read ({_reason(error)}); start again") from None
        now = time.monotonic()
        return [Received(sample.data, now) for sample in found if not isinstance(sample, InvalidSample)]


def _quality(best_effort: bool = False) -> Any:
    reliability = Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(BLOCK_NS)
    # ROS 2 speaks the first version of CDR; cyclonedds would offer the second one too.
    representation = Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False)
    return Qos(reliability, Policy.History.KeepLast(DEPTH), Policy.Durability.Volatile, representation)


def _idl_field(descriptor: Any, messages: Messages) -> Any:
    node, detail = descriptor
    if node is Nodetype.NAME:
        return idl_type(detail, messages)
    if node is Nodetype.BASE:
        name, bound = detail
        return IDL.bounded_str[bound] if name == "string" and bound else BASES[name]
    element, count = detail
    inner = _idl_field(element, messages)
    if node is Nodetype.ARRAY:
        return IDL.array[inner, count]
    return IDL.sequence[inner, count] if count else IDL.sequence[inner]


def _open_domain(config: TransportConfig) -> tuple[Any, tuple[str, ...]]:
    """The domain with the configuration of ours, shared by all of this process, and what to tell of it."""
    if os.environ.get(URI):
        own = f"DDS is set up by {URI}"
        return None, (own if config.network is None else f"{own}: --network {config.network} does not count",)
    number = config.domain_id()
    with _lock:
        domain = _domains.get(number)
        if domain is None:
            try:
                domain = Domain(number, localhost() if config.network is None else _on(config.network))
            except DDSException as error:
                raise DeviceError(f"DDS domain {number}: {_reason(error)}; {_way_out(config)}") from None
            _domains[number], _networks[number] = domain, config.network
        elif _networks[number] != config.network:
            names = [name or "this computer alone" for name in (_networks[number], config.network)]
            raise RigError(f"DDS domain {number} is open on {names[0]}, and cannot be on {names[1]} too: take another")
    if config.network is None:
        return domain, ()
    return domain, (f"everybody on the network of {config.network} can read these topics and write to them",)


def _on(network: str) -> str:
    return _configuration(f"<NetworkInterface name={quoteattr(network)}/>", "", "")


def _configuration(interface: str, general: str, rest: str) -> str:
    inner = f"<General><Interfaces>{interface}</Interfaces>{general}</General>{rest}"
    return f'<CycloneDDS><Domain Id="any">{inner}</Domain></CycloneDDS>'


def _ros_type(name: str) -> str:
    return name.replace("::dds_::", "::").removesuffix("_").replace("::", "/")


def _reason(error: Exception) -> str:
    return " ".join(str(error).split())[:160]


def _way_out(config: TransportConfig) -> str:
    if os.environ.get(URI):
        return f"check {URI}"
    return "is there such a network interface, and is it up?" if config.network else "is loopback up?"
