"""Constants of the robot's control, each with its reason; they can be changed in the robot's
file."""

from pydantic import Field, NonNegativeFloat, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.robot.body_config import SixNotNegative

Six = tuple[
    PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat
]


class AllocationConfig(Configuration):
    """How a wrench is allocated to the fins."""

    priority: Six = (1, 1, 1, 30, 30, 30)
    """Cost of missing a wrench, axis by axis: a newton metre counts as five newtons, because a
    tilted robot pushes in the wrong direction."""
    brace_n: NonNegativeFloat = 1.5
    """Smallest force of each fin, as far as the others can cancel it [N]. The direction of a weak
    force jumps with every small change of the wrench, and a fin that swings around pushes sideways;
    0: no bracing."""
    brace_change: NonNegativeFloat = 1.0
    """Cost of changing the bracing, which swings fins around, relative to that of missing force
    [N2]."""
    smoothing: float = Field(0.5, ge=0, lt=1)
    """Fraction of the change of the forces that is postponed to the next action: a swing spread
    over two actions disturbs half as much, and delays by half an action."""


class ControlConfig(Configuration):
    """Constants of the motion controller; six numbers refer to surge, sway, heave, roll, pitch,
    yaw."""

    bandwidth_rad_s: SixNotNegative = (0.7, 0.7, 0.42, 0, 0, 0.6)
    """Frequency at which errors are corrected [rad/s]. Measuring an error as a mean over two
    actions and waiting for the forces takes half a second in total; a third of 1/delay keeps 60
    degrees of phase."""
    lag_s: float = Field(0.25, ge=0, le=0.33)
    """Delay from commands to forces [s]: fins swing to their new direction, and accelerate the
    water."""
    damping: PositiveFloat = 1.0
    """Damping ratio of the correction [-]."""
    sway_part: float = Field(0.6, gt=0)
    """A robot that has lost a fin and holds its place turns its nose or stern into a current that
    needs more than this fraction of the side force of its other fins: they make a quarter less
    force in a current, and need a reserve for yaw."""
    weathervane_rad_s: NonNegativeFloat = 0.1
    """Largest turn rate for this [rad/s]; 0: it keeps its heading."""
    disturbance: Six = (0.005, 0.005, 0.003, 0.01, 0.01, 0.01)
    """How fast disturbances change: random walk of the acceleration [m/s2, rad/s2 per square root
    of a second]."""
    force_noise: Six = (0.005, 0.005, 0.003, 0.05, 0.03, 0.02)
    """Random acceleration by the fins in addition to the requested one, per action [m/s2,
    rad/s2]."""
    position_noise_m: PositiveFloat = 0.01
    """Assumed noise of the estimated position [m]."""
    attitude_noise_rad: PositiveFloat = 0.0087
    """Assumed noise of the estimated attitude [rad]: half a degree."""
    velocity_noise_m_s: PositiveFloat = 0.02
    """Assumed noise of the estimated velocity [m/s]: half of it comes from the strokes."""
    rate_noise_rad_s: PositiveFloat = 0.01
    """Assumed noise of the estimated angular velocity [rad/s]."""
