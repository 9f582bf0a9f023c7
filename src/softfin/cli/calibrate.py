"""``softfin calibrate``: logs or a plant in, the virtual tank that does the same out, with its uncertainty."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from softfin.cli.common import Configured
from softfin.cli.kinds import Data, Out, numbers
from softfin.cli.options import Option
from softfin.core.choices import CalibratePreset

VELOCITY = Option("LOW,HIGH", parse=numbers("not a range; write LOW,HIGH in rad/s, as 0.3,1.57", count=2))


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Fit the virtual tank to logs or to a plant; report how well each parameter is determined."""

    data: Data
    """Folder of a dataset, or a plant to move: a surrogate's folder, tank, a tank's YAML, or package.module:plant."""
    out: Out
    """Folder to write calibration.json, tank.yaml and the figures to."""
    preset: CalibratePreset = "full"
    """What is fitted: full is fin, water, drive and recording; quick is six numbers, in a minute."""
    evaluations: int | None = None
    """Tanks that the global search tries (4000); 0 leaves it to the local one."""
    velocity: Annotated[tuple[float, ...], VELOCITY] | None = None
    """Range of the commands that move a plant, as LOW,HIGH in rad/s (all that it takes)."""
    seed: int = 0
    """Seed of the search, and of the commands that move a plant."""
    resume: bool = False
    """Go on with a stopped run."""

    def run(self) -> None:
        """Calibrate."""
        from softfin.stages.calibrate import calibrate
        from softfin.tank.calibration.config import PRESETS

        config = self.configured(PRESETS[self.preset], velocity_rad_s=self.velocity)
        result = self.stage(calibrate, self.data, self.out, config, seed=self.seed, resume=self.resume)
        self.tell({"calibration": str(self.out), **result}, table(result))


def table(result: Mapping[str, Any]) -> str:
    """Return the scores, then the parameters."""
    from softfin.cli.tables import aligned

    scores = [["R2 (RMSE)", "angle", "force x", "force y"]]
    for part, title in (("train", "fitted segments"), ("test", "unseen segments")):
        rows = zip(result["scores"][part].values(), ("rad", "N", "N"), strict=True)
        scores.append([title, *(f"{row['r2']:.3f} ({row['rmse']:.2f} {unit})" for row, unit in rows)])
    parameters = [["parameter", "value", "error", "unit", "determined"]]
    for name, row in result["parameters"].items():
        error = "" if row["standard_error"] is None else f"{row['standard_error']:.2g}"
        parameters.append([name, f"{row['value']:.4g}", error, row["unit"], row["determined"]])
    trades = [
        f"{' and '.join(pair['parameters'])} trade against each other: correlation {pair['correlation']:+.2f}"
        for pair in result["trades"]
    ]
    return "\n".join([*aligned(scores), "", *aligned(parameters, (0, 3)), *trades])
