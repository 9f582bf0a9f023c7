"""The example as if it were installed, on topics in simulated time."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from examples.ros2_sensor import softfin_ros2_sensor
from softfin.core.clock import Clock
from softfin.rig.devices import registry
from softfin.storage import plugins
from tests.rig.simulated_topics import SimulatedTransport


def install(patches: pytest.MonkeyPatch) -> None:
    """Add the type `ros2` to the force sensors."""
    entry = EntryPoint("ros2", f"{softfin_ros2_sensor.__name__}:ROS2", registry.GROUP)
    patches.setattr(plugins, "entry_points", lambda group: EntryPoints((entry,)))


def simulate_topics(patches: pytest.MonkeyPatch, clock: Clock) -> None:
    """Connect sensors to the topics of a clock."""
    patches.setattr(softfin_ros2_sensor, "open_transport", lambda config: SimulatedTransport(clock))
