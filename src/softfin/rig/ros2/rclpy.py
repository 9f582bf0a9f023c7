"""ROS 2's topics through rclpy, for a Python that ROS 2 is installed for; messages go in and out as
bytes.

Written after rclpy's documentation and tried with a stand-in for it: it has not met a real ROS 2.
"""

import contextlib
import importlib
import threading
import time
from collections import deque
from typing import Any

from softfin.core.errors import DeviceError, RigError, one_line
from softfin.rig.ros2.config import TransportConfig
from softfin.rig.ros2.connection import DEPTH, Publisher, Quality, Subscriber


class RclpyTransport:
    """Meets the Transport contract: a context and a node of its own, and a thread that takes what
    comes."""

    notes: tuple[str, ...] = (
        "rclpy listens as ROS_LOCALHOST_ONLY and ROS_AUTOMATIC_DISCOVERY_RANGE say",
    )

    def __init__(self, config: TransportConfig) -> None:
        if config.network is not None:
            raise RigError(
                f"--network {config.network} is for DDS; with rclpy ROS 2's own settings choose "
                "the network"
            )
        try:
            rclpy, executors, signals = map(
                importlib.import_module, ("rclpy", "rclpy.executors", "rclpy.signals")
            )
            context = rclpy.Context()
            # Ctrl-C is softfin's: it stops the fin first. No words of the command line are ROS's
            # either.
            rclpy.init(
                args=[],
                context=context,
                domain_id=config.domain_id(),
                signal_handler_options=signals.SignalHandlerOptions.NO,
            )
            self._steps = contextlib.ExitStack()
            self._steps.callback(rclpy.try_shutdown, context=context)
            self._node: Any = rclpy.create_node(config.node, context=context)
            self._steps.callback(self._node.destroy_node)
            self._executor = executors.SingleThreadedExecutor(context=context)
            self._steps.callback(self._executor.shutdown, timeout_sec=1.0)
            self._executor.add_node(self._node)
        except Exception as error:
            # What it raises where the installation is broken is not documented.
            raise RigError(
                f"rclpy cannot be used ({one_line(error)}); use transport: dds"
            ) from None
        self._own: list[str] = []
        self.failure: str | None = None
        threading.Thread(target=self._spin, name="softfin-rclpy", daemon=True).start()

    def publish(self, topic: str, kind: str, deadline_s: float | None = None) -> Publisher:
        """A publisher of the node's."""
        self._own.append(topic)
        publisher = self._node.create_publisher(_class(kind), topic, _offered(deadline_s))

        def send(data: bytes) -> None:
            try:
                # It takes bytes as a message that is serialized already.
                publisher.publish(data)
            except Exception as error:
                # rclpy's own errors are of several modules of its C extension.
                raise DeviceError(
                    f"{topic}: not sent ({one_line(error)}); is ROS 2 still up?"
                ) from None

        return Publisher(send, lambda: int(publisher.get_subscription_count()))

    def subscribe(self, topic: str, kind: str, quality: Quality = "reliable") -> Subscriber:
        """A raw subscription: the bytes as they came."""
        waiting: deque[tuple[bytes, float]] = deque(maxlen=DEPTH)

        def take() -> list[tuple[bytes, float]]:
            if self.failure is not None:
                raise DeviceError(f"rclpy has stopped ({self.failure}); start again")
            return [waiting.popleft() for _ in range(len(waiting))]

        self._node.create_subscription(
            _class(kind),
            topic,
            lambda data: waiting.append((bytes(data), time.monotonic())),
            _asked(quality),
            raw=True,
        )
        # rclpy itself warns of publishers that offer less than is asked for.
        return Subscriber(take, lambda: 0)

    def topics(self) -> dict[str, str]:
        """Topics and types as `ros2 topic list -t` shows them, without ours."""
        found = sorted(self._node.get_topic_names_and_types())
        return {
            name: ", ".join(kinds)
            for name, kinds in found
            if self._node.count_publishers(name) > self._own.count(name)
        }

    def close(self) -> None:
        """End the thread with its executor; any number of times."""
        with contextlib.suppress(Exception):
            self._steps.close()

    def _spin(self) -> None:
        # Whatever ends it ends the messages: those who take must hear of it.
        try:
            self._executor.spin()
            self.failure = "its executor has ended"
        except Exception as error:
            self.failure = one_line(error)


def _asked(quality: Quality) -> Any:
    """Quality of service of a subscription."""
    qos = importlib.import_module("rclpy.qos")
    if quality == "best_effort":
        return qos.QoSProfile(depth=DEPTH, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
    if quality == "latched":
        return qos.QoSProfile(
            depth=DEPTH,
            reliability=qos.ReliabilityPolicy.RELIABLE,
            durability=qos.DurabilityPolicy.TRANSIENT_LOCAL,
        )
    return qos.QoSProfile(depth=DEPTH, reliability=qos.ReliabilityPolicy.RELIABLE)


def _offered(deadline_s: float | None) -> Any:
    """Quality of service of a publisher."""
    qos = importlib.import_module("rclpy.qos")
    if deadline_s is None:
        return qos.QoSProfile(depth=DEPTH, reliability=qos.ReliabilityPolicy.RELIABLE)
    deadline = importlib.import_module("rclpy.duration").Duration(seconds=deadline_s)
    return qos.QoSProfile(
        depth=DEPTH,
        reliability=qos.ReliabilityPolicy.RELIABLE,
        deadline=deadline,
        liveliness=qos.LivelinessPolicy.MANUAL_BY_TOPIC,
        liveliness_lease_duration=deadline,
    )


def _class(kind: str) -> Any:
    package, _, name = kind.split("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError):
        raise RigError(
            f"ROS 2 has no {kind} here; build and source its package, or use transport: dds"
        ) from None
