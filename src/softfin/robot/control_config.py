"""Control parameters of a robot and the reasons for their defaults; they can be changed in the
robot's file."""

from pydantic import Field, NonNegativeFloat, PositiveFloat

from softfin.core.configuration import Configuration
from softfin.robot.body_config import SixNotNegative

Six = tuple[
    PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat, PositiveFloat
]


class AllocationConfig(Configuration):
    """Allocation of a wrench to the fins."""

    priority: Six = (1, 1, 1, 30, 30, 30)
    """Cost of a squared wrench error for each axis; 1 N m costs about as much as 5 N, because a
    tilted robot pushes in the wrong direction."""
    brace_n: NonNegativeFloat = 1.5
    """Minimum force of each fin, as far as the others can cancel it [N]. The direction of a weak
    force jumps with every small change of the wrench, and a fin that swings around pushes sideways.
    0 means no bracing."""
    brace_change: NonNegativeFloat = 1.0
    """Cost of changing the bracing, which swings fins around, relative to that of a squared force
    error [N2]."""
    smoothing: float = Field(0.5, ge=0, lt=1)
    """Fraction of a change of the forces that is postponed to the next action: a swing spread over
    two actions causes half the disturbance and a delay of half an action."""


class ControlConfig(Configuration):
    """Parameters of the motion controller; fields with six numbers refer to surge, sway, heave,
    roll, pitch and yaw."""

    bandwidth_rad_s: SixNotNegative = (0.7, 0.7, 0.42, 0, 0, 0.6)
    """Bandwidth of the error correction [rad/s]. Averaging an error over two actions and waiting
    for the forces causes a total delay of half a second; one third of 1/delay leaves a phase margin
    of 60 degrees."""
    lag_s: float = Field(0.25, ge=0, le=0.33)
    """Delay from commands to forces [s], in which fins swing to their new direction and accelerate
    the water."""
    damping: PositiveFloat = 1.0
    """Damping ratio of the correction [-]."""
    sway_part: float = Field(0.6, gt=0)
    """Fraction of the remaining fins' maximum side force. If a robot that keeps station with a dead
    fin needs more, it turns its bow or stern into the current. Fins produce a quarter less force in
    a current and need a reserve for yaw."""
    weathervane_rad_s: NonNegativeFloat = 0.1
    """Maximum turn rate into a current [rad/s]; 0 means that the robot keeps its heading."""
    disturbance: Six = (0.005, 0.005, 0.003, 0.01, 0.01, 0.01)
    """Rate of change of disturbances: random walk of the acceleration [m/s2/sqrt(s),
    rad/s2/sqrt(s)]."""
    force_noise: Six = (0.005, 0.005, 0.003, 0.05, 0.03, 0.02)
    """Standard deviation of the fins' random acceleration per action [m/s2, rad/s2]."""
    position_noise_m: PositiveFloat = 0.01
    """Assumed noise of the estimated position [m]."""
    attitude_noise_rad: PositiveFloat = 0.0087
    """Assumed noise of the estimated attitude [rad]: half a degree."""
    velocity_noise_m_s: PositiveFloat = 0.02
    """Assumed noise of the estimated velocity [m/s], half of which comes from the strokes."""
    rate_noise_rad_s: PositiveFloat = 0.01
    """Assumed noise of the estimated angular velocity [rad/s]."""
