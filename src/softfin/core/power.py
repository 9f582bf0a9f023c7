"""Power of a drive: what the fin takes from the shaft, and what the motor takes from its supply.

Both are computed for each tick of 10 ms, for NumPy and JAX arrays. The fin returns power to the
shaft during part of each stroke. On the shaft, this power counts as negative, so a mean over a run
is the power that the water takes. The motor returns no power to its supply: electrical power is cut
off at 0 in each tick, because a mean over a whole stroke would offset braking against driving.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypedDict

from jaxtyping import Float

from softfin.core.quantities import AnyArray


class Motor(NamedTuple):
    """Motor and gear of a drive."""

    torque_constant_nm_a: float
    """Torque at the fin per ampere without gear losses [N m/A]: that of the motor times the gear
    ratio. It is also the back-EMF divided by the velocity of the fin [V/(rad/s)]."""
    winding_ohm: float
    """Winding resistance from phase to phase [ohm]."""
    gear_efficiency: float
    """Efficiency of the gear, in both directions [-]."""


EC_MAX_30 = Motor(111 * 0.0259, 1.27 * (25.9 / 24.2) ** 2, 0.7)
"""Drive of the virtual tank: a maxon EC-max 30 (60 W) with a gearhead GP 32 C of 111:1. Nominal
values from memory, not checked against a datasheet: 1.27 ohm and 24.2 mN m/A for the 24 V winding,
and an efficiency of 70% for the gearhead. The tank has 25.9 mN m/A; a winding with this constant
and the same losses has 1.45 ohm."""


def tick_velocity(velocity: Float[AnyArray, "*runs ticks"]) -> Any:
    """Return the mean velocity within each tick, of velocities at the ends of the ticks."""
    xp = velocity.__array_namespace__()
    before = xp.concat([velocity[..., :1], velocity[..., :-1]], axis=-1)
    return (before + velocity) / 2


def mechanical_power(
    torque: Float[AnyArray, "ticks loads"], velocity: Float[AnyArray, "ticks"]
) -> Any:
    """Return the power [W] of mean torques over each tick [N m] at the velocity after each tick
    [rad/s]."""
    return torque * tick_velocity(velocity)[:, None]


def motor_current(torque: Float[AnyArray, "*ticks 2"], velocity: AnyArray, motor: Motor) -> Any:
    """Return the motor current [A] for mean torques on the fin and of the motor [N m] at a mean
    velocity [rad/s]. The gear loses power in the direction of its flow."""
    xp = velocity.__array_namespace__()
    shaft = torque[..., 0]
    efficiency = motor.gear_efficiency
    loss = shaft * xp.where(shaft * velocity > 0, 1 / efficiency, efficiency) - shaft
    return (torque[..., 1] + loss) / motor.torque_constant_nm_a


def electrical_power(current: AnyArray, velocity: AnyArray, motor: Motor) -> Any:
    """Return the power that the motor takes [W] at a current [A] and a velocity of the fin [rad/s]:
    heat in the winding and power of the rotor, or 0 if the sum is negative."""
    power = current * (motor.winding_ohm * current + motor.torque_constant_nm_a * velocity)
    # NaN if the current is not known.
    return power.__array_namespace__().maximum(power, 0.0)


def drive_power(
    torque: Float[AnyArray, "ticks 2"], velocity: Float[AnyArray, "ticks"], motor: Motor = EC_MAX_30
) -> Any:
    """Return the mechanical power on the fin and the electrical power of the motor in each tick,
    ``(ticks, 2)`` [W].

    Parameters
    ----------
    torque
        Mean torques over each tick, on the fin and of the motor, without gear losses [N m].
    velocity
        Velocity at the end of each tick [rad/s].
    """
    rate = tick_velocity(velocity)
    current = motor_current(torque, rate, motor)
    powers = [torque[:, 0] * rate, electrical_power(current, rate, motor)]
    return velocity.__array_namespace__().stack(powers, axis=-1)


class MeanPower(TypedDict):
    """Mean power and what it gives."""

    mean_w: float
    force_per_watt_n: float | None
    """Magnitude of the mean force divided by the mean power [N/W]; None if no power is taken."""
    per_minute_j: float
    """Energy per minute [J]."""


def mean_powers(thrust_n: float, means_w: Sequence[float]) -> dict[str, MeanPower]:
    """Return the known ones of the mean mechanical and electrical power [W] by name, for the
    magnitude of a mean force [N]; NaN if unknown."""
    return {
        name: {
            "mean_w": mean_w,
            "force_per_watt_n": thrust_n / mean_w if mean_w > 0 else None,
            "per_minute_j": 60 * mean_w,
        }
        for name, mean_w in zip(("mechanical", "electrical"), means_w, strict=True)
        if math.isfinite(mean_w)
    }


def power_kind(powers: Mapping[str, MeanPower]) -> str:
    """Return the name of the electrical power, or of the mechanical power if only that is known;
    empty if none is known."""
    return next((name for name in ("electrical", "mechanical") if name in powers), "")


def power_cells(powers: Mapping[str, MeanPower], name: str) -> list[str]:
    """Return a mean power [W] and its force per watt [N/W] as texts."""
    if name not in powers:
        return ["-", "-"]
    ratio = powers[name]["force_per_watt_n"]
    return [f"{powers[name]['mean_w']:.2f}", "-" if ratio is None else f"{ratio:.2f}"]


def describe_powers(powers: Mapping[str, MeanPower]) -> str:
    """Return the mean powers, the force per watt and the energy per minute on one line; empty if
    none is known."""
    name = power_kind(powers)
    if not name:
        return ""
    means = ", ".join(f"{own['mean_w']:.2f} W {name}" for name, own in powers.items())
    _, ratio = power_cells(powers, name)
    each = f"{ratio} N/W, {powers[name]['per_minute_j']:.0f} J per minute"
    return f"mean power {means}; {each}"
