"""The life-cycle node of one fin.

The main thread runs the loop of `ManagedFin`, because only the main thread receives signals. The
threads of the executor receive messages and requests; if the executor ends, the loop stops the fin.
"""

import contextlib
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import rclpy
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor, MultiThreadedExecutor
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from std_srvs.srv import Trigger

from softfin.core.errors import SafetyStop
from softfin.rig.ros2.inputs import EmergencyStop, OnceReporter
from softfin.rig.ros2.rclpy import NodeTransport
from softfin.rig.session import in_one_line
from softfin.rig.stop import StopRequest, stopped_by_signals
from softfin_ros import parameters
from softfin_ros.fin_parameters import FinParameters
from softfin_ros.managed_fin import ManagedFin
from softfin_ros.status import FinStatus

TOPICS = ("joint_states", "wrench", "command", "reference", "stop", "stop_reason", "current")
FIELDS = {"joint_states_topic": "joint_topic"}
CHECK_S = 0.1
"""Time between two checks whether the fin was stopped [s]."""
READ_S = 0.05
"""Time between two looks at the stop topic [s]; its reader keeps ten messages."""
FIXED = {"arm", "autostart"}
"""Parameters that no other node may change."""
THREADS = 4
"""Number of callback groups, so that none waits for another."""


class FinNode(LifecycleNode):
    """Life cycle, services and parameters around a `ManagedFin`."""

    def __init__(self) -> None:
        super().__init__("softfin")
        parameters.declare(self, FinParameters.model_fields)
        topics = parameters.resolve(self, TOPICS)
        self._topics = {FIELDS.get(name, name): topic for name, topic in topics.items()}
        name = self.get_namespace().strip("/") or self.get_name()
        self._recording = name.replace("/", "_")
        warn = self.get_logger().warning
        # These exist as long as the node, so no transition forgets a stop.
        live = MutuallyExclusiveCallbackGroup()
        self._transport = NodeTransport(self, live)
        self._emergency_stop = EmergencyStop(
            self._transport, self._topics["stop_topic"], OnceReporter(warn)
        )
        status = FinStatus(self._transport, self._topics.pop("stop_reason_topic"), name, warn)
        self._fin = ManagedFin(self._emergency_stop, status)
        # Ten messages after a stop would push it out of the queue.
        self._transport.on_message = self._fin.read_stop
        # These exist only while the node is configured.
        self._configured_transport = NodeTransport(self, MutuallyExclusiveCallbackGroup())
        self._is_configured = False
        self._is_active = False
        # Transitions and `~/zero` wait for the loop; `live` never waits, and no flood of references
        # delays it. Simulated time may stand still, and the wall clock may be set.
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._serve("~/stop", lambda: self._fin.stop("stopped by the service ~/stop"), live)
        self._serve("~/reset", self._fin.reset, live)
        self._serve("~/zero", self._fin.zero, MutuallyExclusiveCallbackGroup())
        self.create_timer(READ_S, self._fin.read_stop, callback_group=live, clock=steady)
        self._is_starting = bool(self.get_parameter("autostart").value)
        self.create_timer(CHECK_S, self._check, clock=steady)
        self.add_on_set_parameters_callback(self._refuse_changes)

    def run(self, signals: StopRequest) -> int:
        """Move the fin whenever it is active, until a signal or the end of the executor, and return
        the exit code: 3 if a stop is remembered."""
        # A second Ctrl-C interrupts a loop that does not respond to the first.
        with contextlib.suppress(KeyboardInterrupt):
            self._fin.run(signals)
        reason = self._emergency_stop.reason()
        if reason is None:
            return 0
        self.get_logger().error(reason)
        return SafetyStop.exit_code

    def spin(self, executor: Executor) -> None:
        """Receive messages and requests until the executor ends, which also ends `run`."""
        try:
            self._transport.spin(executor)
        finally:
            failure = self._transport.failure
            self._fin.end(f"cannot receive messages ({failure}); restart the node")

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
        """Forget the controller, but not a stop."""
        return self._attempt(self._release)

    on_shutdown = on_cleanup
    on_error = on_cleanup

    def _configure(self) -> None:
        values = parameters.read(self, FinParameters.model_fields)
        given = FinParameters.build(values, "parameters")
        try:
            driven = given.connect(self._configured_transport, self._topics, self._emergency_stop)
        except BaseException:
            self._configured_transport.close()
            raise
        self._fin.configure(driven, Path(given.folder) / self._recording)
        self._is_configured = True

    def _activate(self) -> None:
        self._fin.activate()
        self._is_active = True

    def _deactivate(self) -> None:
        # After a stop, the fin is at rest but the node is still active; so a deactivation succeeds.
        self._is_active = False
        self._fin.deactivate()
        if (reason := self._emergency_stop.reason()) is not None:
            self.get_logger().error(reason)

    def _release(self) -> None:
        self._deactivate()
        self._fin.release()
        self._configured_transport.close()
        self._is_configured = False

    def _refuse_changes(self, changes: list[Parameter]) -> SetParametersResult:
        """Accept parameters only while they can take effect."""
        names = {each.name for each in changes}
        if fixed := sorted(names & FIXED):
            reason = (
                f"{', '.join(fixed)}: can only be set at the start; set it when you start the node"
            )
        elif own := self._is_configured and sorted(names & FinParameters.model_fields.keys()):
            reason = f"{', '.join(own)}: cannot be changed after configure; clean up the node first"
        else:
            return SetParametersResult(successful=True)
        return SetParametersResult(successful=False, reason=reason)

    def _attempt(self, transition: Callable[[], None]) -> TransitionCallbackReturn:
        try:
            transition()
        except Exception as error:
            self.get_logger().error(in_one_line(error, "the transition failed"))
            return TransitionCallbackReturn.FAILURE
        return TransitionCallbackReturn.SUCCESS

    def _serve(
        self, name: str, act: Callable[[], None], group: MutuallyExclusiveCallbackGroup
    ) -> None:
        def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            try:
                act()
                response.success = True
            except Exception as error:
                response.success = False
                response.message = in_one_line(error, "the service failed")
            return response

        self.create_service(Trigger, name, answer, callback_group=group)

    def _check(self) -> None:
        """Deactivate the node if its fin was stopped; configure and activate it at the start."""
        if self._is_starting:
            self._is_starting = False
            if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
                self.trigger_activate()
        elif self._is_active and not self._fin.is_wanted:
            self.trigger_deactivate()


def main() -> int:
    """Run the node until a signal, and return the exit code; a fin that moves is stopped first."""
    signals = StopRequest()
    # softfin handles signals itself, because it must stop the fin first, and because a repeated
    # Ctrl-C must not change the exit code.
    with stopped_by_signals(signals):
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        node = FinNode()
        executor = MultiThreadedExecutor(num_threads=THREADS)
        executor.add_node(node)
        threading.Thread(target=node.spin, args=(executor,), daemon=True).start()
        try:
            return node.run(signals)
        finally:
            # The motor is off; a repeated Ctrl-C must not change the exit code.
            signals.is_obeyed = True
            executor.shutdown(timeout_sec=1.0)
            node.destroy_node()
            rclpy.try_shutdown()
