"""What a calibration fits, to how much data, and how long it searches."""

from typing import Any

from pydantic import Field, field_validator, model_validator

from softfin.core.choices import CalibratePreset
from softfin.core.configuration import Configuration
from softfin.data.excitation import ExcitationConfig
from softfin.tank import TankConfig
from softfin.tank.calibration.parameters import FREE, Range, Ranges, every_range, nested
from softfin.tank.calibration.recording import RecordingConfig


class Weights(Configuration):
    """Weights of the channels in the loss, relative to each other."""

    angle: float = Field(1.0, ge=0)
    """Weight of 1 - R2 of the shaft's angle."""
    force_x: float = Field(1.0, ge=0)
    """Weight of 1 - R2 of the force along x."""
    force_y: float = Field(1.0, ge=0)
    """Weight of 1 - R2 of the force along y."""

    @model_validator(mode="after")
    def _some(self) -> "Weights":
        if self.angle + self.force_x + self.force_y == 0:
            raise ValueError("at least one channel must weigh something")
        return self


class CalibrateConfig(Configuration):
    """How a tank is fitted."""

    parameters: Ranges = Field(default_factory=every_range, validate_default=True)
    """Range [low, high] of each number that is sought; null keeps it as `tank` or `recording` has it."""
    tank: TankConfig = TankConfig()
    """Where the search starts, and all that it does not change."""
    recording: RecordingConfig = RecordingConfig()
    """The recording at the start of the search, and all of it that the search does not change."""
    weights: Weights = Weights()
    """Weights of the channels in the loss."""
    evaluations: int = Field(4000, ge=0)
    """Tanks that the global search (CMA-ES) tries; 0: only the local one, from where `tank` is."""
    population: int = Field(16, ge=4)
    """Tanks of one generation, simulated side by side."""
    step: float = Field(0.1, gt=0, le=1)
    """Standard deviation of the first generation, over the width of each range."""
    search_plates: int = Field(4, ge=1, le=32)
    """Plates of the fin in the global search; the local one has the plates of `tank`."""
    search_steps: int = Field(1, ge=1)
    """Steps of time a tick in the global search; the local one has those of `tank`."""
    iterations: int = Field(12, ge=1)
    """Most steps of the local search (Levenberg-Marquardt); it ends when a step gains less than 1e-6."""
    pieces: int = Field(24, ge=2)
    """Pieces of the training logs that are fitted."""
    test_pieces: int = Field(12, ge=1)
    """Pieces of the test logs that the fit is judged on."""
    piece_s: float = Field(12.0, ge=0.1)
    """Length of each piece [s]."""
    warm_up_s: float = Field(2.0, ge=0)
    """Start of each piece that is simulated but not compared [s]: longer than a stroke, so that one under way ends."""
    block_s: float = Field(2.0, ge=0.01)
    """Stretches [s] whose errors are taken to be independent of each other when standard errors are computed."""
    excitation: ExcitationConfig = ExcitationConfig()
    """Excitation of a plant that is to be fitted; logs bring their own commands."""
    velocity_rad_s: Range | None = None
    """Range of the velocities that the plant is commanded in the excitation; null: that of its limits."""

    @field_validator("parameters", mode="before")
    @classmethod
    def _dotted(cls, value: Any) -> Any:
        return nested(value) if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _long_enough(self) -> "CalibrateConfig":
        if self.piece_s < self.warm_up_s + self.block_s:
            raise ValueError(f"piece_s = {self.piece_s:g} must be at least warm_up_s + block_s")
        return self


def _fewer(names: tuple[str, ...]) -> Ranges:
    return every_range({name: FREE[name] for name in names})


PRESETS: dict[CalibratePreset, CalibrateConfig] = {
    "full": CalibrateConfig(),
    "quick": CalibrateConfig(
        parameters=_fewer((
            "drive.acceleration_rad_s2", "drive.lag_s", "fin.length_m", "fin.youngs_modulus_pa",
            "water.added_mass_coefficient", "water.drag_coefficient",
        )),
        evaluations=800, iterations=8, pieces=12, test_pieces=6,
    ),
}  # fmt: skip
"""``full``: fin, water, drive and recording. ``quick``: what tells most, in a minute, the log taken as it is."""
