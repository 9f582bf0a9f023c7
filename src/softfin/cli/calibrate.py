"""``softfin calibrate``: logs or a plant in, the virtual tank that does the same out, with what is known of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeAlias

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import Data, Out, numbers
from softfin.cli.options import Option
from softfin.core.choices import CalibratePreset

VelocityRange: TypeAlias = Annotated[
    tuple[float, ...], Option("LOW,HIGH", parse=numbers("no range; write LOW,HIGH in rad/s, as 0.3,1.57", count=2))
]


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Fit the virtual tank to logs or to a plant; say how well each parameter is determined."""

    data: Data
    """Folder of a dataset, or a plant to move: a surrogate's folder, tank, a tank's YAML, or package.module:plant."""
    out: Out
    """Folder to write calibration.json, tank.yaml and the figures to."""
    preset: CalibratePreset = "full"
    """What is fitted: full is fin, water, drive and recording; quick is six numbers, in a minute."""
    evaluations: int | None = None
    """Tanks that the global search tries (4000); 0 leaves it to the local one."""
    velocity: VelocityRange | None = None
    """Range of the commands that move a plant, as LOW,HIGH in rad/s (all that it takes)."""
    seed: int = 0
    """Seed of the search, and of the commands that move a plant."""
    resume: bool = False
    """Go on with a stopped run."""

    def run(self) -> None:
        """Calibrate."""
        from softfin.stages.calibrate import calibrate
        from softfin.tank.calibration.config import PRESETS

        config = self.configured(PRESETS[self.preset], evaluations=self.evaluations, velocity_rad_s=self.velocity)
        with progress() as report:
            result = calibrate(
                self.data, Path(self.out), config,
                seed=self.seed, resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        self.tell({"calibration": str(self.out), **result}, table(result))


def table(result: Mapping[str, Any]) -> str:
    """Scores and parameters for a terminal."""
    lines = [f"{'R2 (RMSE)':34}{'angle':>18}{'force x':>18}{'force y':>18}"]
    for part, title in (("train", "fitted segments"), ("test", "unseen segments")):
        rows = result["scores"][part]
        units = {"angle": "rad", "force_x": "N", "force_y": "N"}
        cells = [f"{row['r2']:.3f} ({row['rmse']:.2f} {units[channel]})" for channel, row in rows.items()]
        lines.append(f"{title:34}" + "".join(f"{cell:>18}" for cell in cells))
    lines += ["", f"{'parameter':34}{'value':>11}{'error':>11}  {'unit':8}{'determined':>12}"]
    for name, row in result["parameters"].items():
        error = "" if row["standard_error"] is None else f"{row['standard_error']:.2g}"
        lines.append(f"{name:34}{row['value']:>11.4g}{error:>11}  {row['unit']:8}{row['determined']:>12}")
    for pair in result["trades"]:
        one, other = pair["parameters"]
        lines.append(f"{one} and {other} trade against each other: correlation {pair['correlation']:+.2f}")
    return "\n".join(lines)
