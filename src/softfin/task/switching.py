"""How a grid's policies take over from one another: settings that training writes and the controller obeys."""

from pydantic import Field, NonNegativeFloat, PositiveFloat

from softfin.core.action_clock import CYCLE_ACTIONS
from softfin.core.configuration import Configuration


class SwitchingConfig(Configuration):
    """How one policy takes over from another."""

    margin_n: NonNegativeFloat = 0.1
    """The policy in charge stays until another cell is nearer to the reference by more than this [N], so that a
    reference on the border does not switch for ever; the policies still hold a reference that little beyond theirs."""
    fade_actions: int = Field(default=6, ge=0, le=CYCLE_ACTIONS)
    """Actions over which the new policy's are faded in; 0 switches at once."""
    step_n: PositiveFloat = 0.5
    """A reference that moves by this or more from one action to the next [N] is a step: the beat must change, and
    nothing is faded. Smaller moves fade in part."""
    replay: bool = True
    """Whether the new policy remembers the last six actions as if it had been in charge, or nothing at all."""
