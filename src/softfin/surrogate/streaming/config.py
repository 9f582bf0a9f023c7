"""How streaming surrogates are fitted."""

from pydantic import Field, PositiveInt, model_validator

from softfin.core.configuration import Configuration
from softfin.surrogate.streaming.drive import DriveNetConfig
from softfin.surrogate.streaming.force import ForceNetConfig


class StreamingConfig(Configuration):
    """An ensemble of nets with a state of their own; docs/surrogates.md measures what each choice is worth."""

    drive: DriveNetConfig = DriveNetConfig()
    """Commands to motion."""
    force: ForceNetConfig = ForceNetConfig()
    """Motion to force."""
    members: PositiveInt = 5
    """Of the ensemble, trained side by side from different weights on different stretches."""
    drive_updates: PositiveInt = 600
    """Of the drive nets; the learning rate falls to a hundredth over them (cosine)."""
    force_updates: PositiveInt = 2000
    """Of the force nets, likewise."""
    batch: PositiveInt = 32
    """Stretches of the logs an update and member."""
    ticks: int = Field(default=400, ge=2)
    """Length of a stretch [10 ms]; gradients go back through all of it."""
    burn_in: int = Field(default=100, ge=0)
    """Ticks at the beginning of a stretch whose errors do not count: what was before it is not known."""
    learning_rate: float = Field(default=3e-3, gt=0)
    """Of Adam, at its greatest."""
    free_running: tuple[float, float] = (0.2, 0.8)
    """Parts of the force nets' training between which they change from the measured to the predicted motion."""
    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Share of the training logs kept for choosing weights and calibrating intervals; at least one log."""

    @model_validator(mode="after")
    def _in_order(self) -> "StreamingConfig":
        if self.burn_in >= self.ticks:
            raise ValueError(f"burn_in must be less than ticks = {self.ticks}, or no error counts")
        if not 0 <= self.free_running[0] <= self.free_running[1] <= 1:
            raise ValueError("free_running must be two parts of the training in order, such as 0.2, 0.8")
        return self
