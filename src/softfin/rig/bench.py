"""A machine with all that is to know of how to treat it."""

from dataclasses import dataclass, field
from typing import Any

from softfin.core.errors import RigError
from softfin.core.quantities import Limits
from softfin.rig.machine import Machine
from softfin.rig.safety import SafetyConfig


@dataclass(frozen=True)
class Bench:
    """What a name such as ``rig`` stands for."""

    machine: Machine
    safety: SafetyConfig
    fin: str | None = None
    """What this fin is called; None where nobody says."""
    settle_s: float = 5.0
    """How long the fin rests before each log or experiment [s]."""
    described: dict[str, Any] = field(default_factory=dict)
    """Its whole configuration, for JSON."""


def check_fits(named: str, limits: Limits, fin: str | None, bench: Bench) -> None:
    """Raise RigError where a controller is for another fin, or commands what this machine does not take."""
    if fin is not None and bench.fin is not None and fin != bench.fin:
        raise RigError(
            f"{named}: trained for the fin {fin!r}; this rig's is {bench.fin!r}; train one for it, or correct 'fin' in "
            "the rig's file"
        )
    taken = bench.machine.limits
    for low, high, unit in (("angle_min", "angle_max", "rad"), ("velocity_min", "velocity_max", "rad/s")):
        ours, theirs = ((getattr(each, low), getattr(each, high)) for each in (limits, taken))
        if ours[0] < theirs[0] - 1e-3 or ours[1] > theirs[1] + 1e-3:
            quantity = low.removesuffix("_min")
            raise RigError(
                f"{named}: commands a {quantity} of {ours[0]:.5g} .. {ours[1]:.5g} {unit}; {bench.machine.name} takes "
                f"{theirs[0]:.5g} .. {theirs[1]:.5g}; train it within these, or widen the rig's limits"
            )
