"""``softfin train``: a surrogate in, a controller out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

from softfin import stages
from softfin.artifacts import load_description
from softfin.cli.common import Configured, Out, progress
from softfin.control.store import KIND
from softfin.training.train import GRID, SINGLE


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Train LSTM-PPO force controllers inside a surrogate (paper Sec. III-C)."""

    surrogate: tyro.conf.Positional[str]
    """Folder of the surrogate; any other plant serves too (tank, package.module:plant)."""
    out: Out
    """Folder of the controller to write."""
    controller: Literal["single", "grid"] = "grid"
    """One policy for all references, or one a cell of a grid."""
    steps: int | None = None
    """Actions a policy (the paper's 30,000 single, 10,000 a cell)."""
    seed: int = 0
    """Of weights, exploration and references."""
    resume: bool = False
    """Go on from the last checkpoint of an unfinished run."""

    def run(self) -> None:
        """Train."""
        config = self.configured(
            {"single": SINGLE, "grid": GRID}[self.controller], controller=self.controller, steps=self.steps
        )
        with progress() as report:
            stages.train(
                self.surrogate, Path(self.out), config,
                seeds=[self.seed], resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        scores = load_description(Path(self.out), KIND)["scores"]
        lines = [f"{self.out}: scored in {self.surrogate}, without exploration noise", "reference [N]   error x, y [N]"]
        lines += [f"({r[0]:5.2f}, {r[1]:5.2f})   {e[0]:.3f}, {e[1]:.3f}" for r, e in
                  ((row["reference_n"], row["error_n"]) for row in scores)]  # fmt: skip
        self.tell({"controller": str(self.out), "scores": scores}, "\n".join(lines))
