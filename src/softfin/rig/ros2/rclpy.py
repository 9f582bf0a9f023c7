"""ROS 2 topics through rclpy, for Python environments with ROS 2; messages are sent and received as
bytes.

Written from the rclpy documentation and tested with a substitute for rclpy, not yet with a real ROS
2 installation.
"""

import contextlib
import importlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from softfin.core.errors import DeviceError, RigError, one_line
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import DEPTH, Publisher, Quality, Subscriber


class NodeTransport:
    """Transport over an existing rclpy node, which its owner spins and destroys."""

    notes: tuple[str, ...] = (
        "the discovery range of rclpy is set by ROS_LOCALHOST_ONLY and "
        "ROS_AUTOMATIC_DISCOVERY_RANGE",
    )

    def __init__(self, node: Any, callback_group: object = None) -> None:
        """`callback_group` is the group of the subscriptions; None for the default group."""
        self._node = node
        self.on_message: Callable[[], object] = lambda: None
        """Function that is called after each message has arrived."""
        self._group = callback_group
        self._own: list[str] = []
        self._entities: list[tuple[Callable[[object], object], object]] = []
        """Publishers and subscriptions, with the function that destroys each."""
        self.failure: str | None = None
        """Reason why no more messages arrive; None while they do."""

    def publish(
        self, topic: str, kind: str, deadline_s: float | None = None, latched: bool = False
    ) -> Publisher:
        """Create a publisher."""
        self._own.append(topic)
        publisher = self._node.create_publisher(_class(kind), topic, _offered(deadline_s, latched))
        self._entities.append((self._node.destroy_publisher, publisher))

        def send(data: bytes) -> None:
            try:
                # `publish` accepts bytes as a serialized message.
                publisher.publish(data)
            except Exception as error:
                # Exceptions in rclpy come from several modules of its C extension.
                raise DeviceError(
                    f"{topic}: message not sent ({one_line(error)}); check whether ROS 2 is still "
                    "running"
                ) from None

        return Publisher(send, lambda: int(publisher.get_subscription_count()))

    def subscribe(
        self, topic: str, kind: str, quality: Quality = "reliable", depth: int = DEPTH
    ) -> Subscriber:
        """Create a raw subscription, which returns the received bytes."""
        waiting: deque[tuple[bytes, float]] = deque(maxlen=depth)

        def take() -> list[tuple[bytes, float]]:
            if self.failure is not None:
                raise DeviceError(f"rclpy has stopped ({self.failure}); start softfin again")
            return [waiting.popleft() for _ in range(len(waiting))]

        def receive(data: Any) -> None:
            waiting.append((bytes(data), time.monotonic()))
            self.on_message()

        subscription = self._node.create_subscription(
            _class(kind),
            topic,
            receive,
            _asked(quality, depth),
            raw=True,
            callback_group=self._group,
        )
        self._entities.append((self._node.destroy_subscription, subscription))

        # rclpy itself warns about publishers with a lower quality of service than requested.
        return Subscriber(take, lambda: 0, lambda: self._publisher_names(topic))

    def topics(self) -> dict[str, str]:
        """Return topics and types as in `ros2 topic list -t`, without our own topics."""
        found = sorted(self._node.get_topic_names_and_types())
        return {
            name: ", ".join(kinds)
            for name, kinds in found
            if self._node.count_publishers(name) > self._own.count(name)
        }

    def publishers(self, topic: str) -> list[str]:
        """Return the sorted names of other nodes that publish on a topic."""
        # Subtract only our own publishers: a different node may have the same name as ours.
        name = self._node.get_fully_qualified_name()
        own = Counter({name: self._own.count(topic)})
        return sorted((Counter(self._publisher_names(topic)) - own).elements())

    def spin(self, executor: Any) -> None:
        """Run the executor of the node until it ends; then no more messages arrive, which readers
        must report."""
        failure = "its executor has ended"
        try:
            executor.spin()
        except Exception as error:
            failure = one_line(error)
        finally:
            self.failure = failure

    def close(self) -> None:
        """Destroy the publishers and subscriptions; the node stays."""
        for destroy, entity in self._entities:
            destroy(entity)
        self._entities.clear()
        self._own.clear()

    def _publisher_names(self, topic: str) -> list[str]:
        found = self._node.get_publishers_info_by_topic(topic)
        return [f"{each.node_namespace.rstrip('/')}/{each.node_name}" for each in found]


class RclpyTransport(NodeTransport):
    """Transport over rclpy, with its own context, node and receiver thread."""

    def __init__(self, config: TransportConfig) -> None:
        if config.network is not None:
            raise RigError(
                f"--network {config.network} applies only to DDS; rclpy uses the network settings "
                "of ROS 2, so remove --network"
            )
        try:
            rclpy, executors, signals = map(
                importlib.import_module, ("rclpy", "rclpy.executors", "rclpy.signals")
            )
            context = rclpy.Context()
            # softfin handles Ctrl-C itself, because it must stop the fin first. Its command line
            # contains no ROS arguments.
            rclpy.init(
                args=[],
                context=context,
                domain_id=config.domain_id(),
                signal_handler_options=signals.SignalHandlerOptions.NO,
            )
            self._steps = contextlib.ExitStack()
            self._steps.callback(rclpy.try_shutdown, context=context)
            node = rclpy.create_node(config.node, context=context)
            self._steps.callback(node.destroy_node)
            self._executor = executors.SingleThreadedExecutor(context=context)
            self._steps.callback(self._executor.shutdown, timeout_sec=1.0)
            self._executor.add_node(node)
        except Exception as error:
            # The exceptions raised in a broken installation are not documented.
            raise RigError(
                f"rclpy cannot be used ({one_line(error)}); use transport: dds"
            ) from None
        super().__init__(node)
        threading.Thread(
            target=self.spin, args=(self._executor,), name="softfin-rclpy", daemon=True
        ).start()

    def close(self) -> None:
        """Shut down the executor, which ends the thread; may be called repeatedly."""
        with contextlib.suppress(Exception):
            self._steps.close()


def _asked(quality: Quality, depth: int) -> object:
    """Return the quality of service for a subscription."""
    qos = importlib.import_module("rclpy.qos")
    policies = {"depth": depth, "reliability": qos.ReliabilityPolicy.RELIABLE}
    if quality == "best_effort":
        policies["reliability"] = qos.ReliabilityPolicy.BEST_EFFORT
    if quality == "latched":
        policies["durability"] = qos.DurabilityPolicy.TRANSIENT_LOCAL
    return qos.QoSProfile(**policies)


def _offered(deadline_s: float | None, latched: bool) -> object:
    """Return the quality of service for a publisher."""
    qos = importlib.import_module("rclpy.qos")
    if latched:
        return _asked("latched", 1)
    if deadline_s is None:
        return _asked("reliable", DEPTH)
    deadline = importlib.import_module("rclpy.duration").Duration(seconds=deadline_s)
    return qos.QoSProfile(
        depth=DEPTH,
        reliability=qos.ReliabilityPolicy.RELIABLE,
        deadline=deadline,
        liveliness=qos.LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=deadline,
    )


def _class(kind: str) -> object:
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise RigError(
            f"this ROS 2 installation does not have {kind}; build and source its package, or use "
            "transport: dds"
        ) from None
