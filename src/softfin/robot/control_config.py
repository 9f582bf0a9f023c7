"""Constants of the robot's control, each with its reason; the robot's file changes them."""

from pydantic import Field, NonNegativeFloat, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.robot.body_config import SixNotNegative

Six = tuple[
    PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat
]


class AllocationConfig(Configuration):
    """How a wrench is shared among the fins."""

    priority: Six = (1, 1, 1, 30, 30, 30)
    """Cost of missing a wrench, axis by axis: a newton metre counts as five newtons, as a robot
    that tilts pushes the wrong way."""
    brace_n: NonNegativeFloat = 1.5
    """Force that each fin makes at least where the others can cancel it [N]. The direction of a
    weak force flickers with every small change of the wrench, and a fin that swings round pushes
    aside; 0: no bracing."""
    brace_change: NonNegativeFloat = 1.0
    """Cost of changing the bracing, in squares of newtons, against that of lacking force: it swings
    fins round."""
    smoothing: float = Field(0.5, ge=0, lt=1)
    """Part of the change of the forces that waits for the next action: a swing that is spread over
    two actions disturbs half as much, and delays by half an action."""


class ControlConfig(Configuration):
    """Constants of the motion controller; six numbers are of surge, sway, heave, roll, pitch,
    yaw."""

    bandwidth_rad_s: SixNotNegative = (0.7, 0.7, 0.42, 0, 0, 0.6)
    """Frequency at which errors are corrected [rad/s]. An error is seen as a mean over two actions
    and forces follow, half a second in all; a third of 1/delay keeps 60 degrees of phase."""
    lag_s: float = Field(0.25, ge=0, le=0.33)
    """Time by which forces follow their commands [s]: fins swing to their new direction, and set
    the water going."""
    damping: PositiveFloat = 1.0
    """Damping ratio of the correction [-]."""
    sway_part: float = Field(0.6, gt=0)
    """A robot that has lost a fin and holds its place turns nose or stern into a current that takes
    more than this part of what its other fins make to the side: they make a quarter less in a
    current, and need something for yaw."""
    weathervane_rad_s: NonNegativeFloat = 0.1
    """Fastest turning to that end [rad/s]; 0: it keeps its heading."""
    disturbance: Six = (0.005, 0.005, 0.003, 0.01, 0.01, 0.01)
    """How fast disturbances change: random walk of the acceleration [m/s2, rad/s2 per square root
    of a second]."""
    force_noise: Six = (0.005, 0.005, 0.003, 0.05, 0.03, 0.02)
    """Acceleration that the fins make beside what they are asked for, action by action [m/s2,
    rad/s2]."""
    position_noise_m: PositiveFloat = 0.01
    """Noise that the estimate's position is taken to have [m]."""
    attitude_noise_rad: PositiveFloat = 0.0087
    """Noise that its attitude is taken to have [rad]: half a degree."""
    velocity_noise_m_s: PositiveFloat = 0.02
    """Noise that its velocity is taken to have [m/s]: strokes add as much again to the estimate's
    own."""
    rate_noise_rad_s: PositiveFloat = 0.01
    """Noise that its angular velocity is taken to have [rad/s]."""
