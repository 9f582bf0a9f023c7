"""The life-cycle node of one fin.

It moves the fin only while it is active. The main thread runs the 100 Hz loop, because only the
main thread receives signals; the threads of the executor receive messages and requests.
"""

import contextlib
import queue
import sys
import threading
from collections.abc import Callable

import rclpy
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from softfin.core.errors import RigError, SoftfinError
from softfin.rig.ros2.rclpy import NodeTransport
from softfin.rig.stop import SIGNAL_CHECK_S
from softfin_ros import parameters
from softfin_ros.managed_fin import FinParameters, ManagedFin

TOPICS = ("joint_states", "wrench", "command", "reference", "stop", "stop_reason", "current")
FIELDS = {"joint_states_topic": "joint_topic"}
CHECK_S = 0.1
"""Time between two checks whether the fin was stopped [s]."""


class FinNode(LifecycleNode):
    """Life cycle, services and parameters around a `ManagedFin`."""

    def __init__(self) -> None:
        super().__init__("softfin")
        parameters.declare(self, FinParameters.model_fields)
        self._fin: ManagedFin | None = None
        self._is_active = False
        self._configured: queue.SimpleQueue[ManagedFin] = queue.SimpleQueue()
        # Messages and stops arrive while a transition or `~/zero` waits in the default group.
        self._live = MutuallyExclusiveCallbackGroup()
        self._transport = NodeTransport(self, self._live)
        self._serve("~/stop", lambda fin: fin.stop("stopped by the service ~/stop"), self._live)
        self._serve("~/reset", ManagedFin.reset)
        self._serve("~/zero", ManagedFin.zero)
        self._is_starting = bool(self.get_parameter("autostart").value)
        self.create_timer(CHECK_S, self._check)

    def run(self) -> None:
        """Move the fin in this thread whenever it is active, until a signal."""
        while True:
            with contextlib.suppress(queue.Empty):
                # Without a timeout, a signal that another thread receives would not wake us.
                if self._configured.get(timeout=SIGNAL_CHECK_S).run():
                    return

    def on_configure(self, state: object) -> TransitionCallbackReturn:
        """Load the controller and create the topics."""
        return self._attempt(self._configure)

    def on_activate(self, state: object) -> TransitionCallbackReturn:
        """Power the motor and start the controller."""
        return self._attempt(self._activate)

    def on_deactivate(self, state: object) -> TransitionCallbackReturn:
        """Stop the fin and disable the motor."""
        return self._attempt(self._deactivate)

    def on_cleanup(self, state: object) -> TransitionCallbackReturn:
        """Forget the controller."""
        return self._attempt(self._release)

    on_shutdown = on_cleanup
    on_error = on_cleanup

    def _configure(self) -> None:
        topics = parameters.resolve(self, TOPICS)
        named = {FIELDS.get(name, name): topic for name, topic in topics.items()}
        name = self.get_namespace().strip("/").replace("/", "_") or self.get_name()
        values = parameters.read(self, FinParameters.model_fields)
        given = FinParameters.build(values, "parameters")
        self._fin = given.connect(self._transport, named, name)
        self._configured.put(self._fin)

    def _activate(self) -> None:
        self._configured_fin().activate()
        self._is_active = True

    def _deactivate(self) -> None:
        self._is_active = False
        self._configured_fin().deactivate()

    def _release(self) -> None:
        self._is_active = False
        if self._fin is not None:
            self._fin.shut_down()
            self._fin = None
        self._transport.close()

    def _configured_fin(self) -> ManagedFin:
        if self._fin is None:
            raise RigError("the node is unconfigured; configure it first")
        return self._fin

    def _attempt(self, transition: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            transition()
        except SoftfinError as error:
            self.get_logger().error(str(error))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _serve(
        self,
        name: str,
        act: Callable[[ManagedFin], None],
        group: MutuallyExclusiveCallbackGroup | None = None,
    ) -> None:
        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                act(self._configured_fin())
                response.success = True
            except SoftfinError as error:
                response.success = False
                response.message = str(error)
            return response

        self.create_service(Trigger, name, answer, callback_group=group)

    def _check(self) -> None:
        """Deactivate the node if its fin was stopped; configure and activate it at the start."""
        if self._is_starting:
            self._is_starting = False
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()
        elif self._is_active and self._fin is not None and self._fin.state == "stopped":
            self.get_logger().error(self._fin.reason)
            self.trigger_deactivate()


def main() -> None:
    """Run the node until a signal; a fin that moves is stopped first."""
    # softfin handles signals itself, because it must stop the fin first.
    rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
    node = FinNode()
    executor = MultiThreadedExecutor(num_threads=3)
    executor.add_node(node)
    threading.Thread(target=executor.spin, daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        node.run()
    executor.shutdown(timeout_sec=1.0)
    node.destroy_node()
    rclpy.try_shutdown()
