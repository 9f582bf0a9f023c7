"""``softfin train``: a surrogate in, a controller out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import tyro

from softfin import stages
from softfin.artifacts import load_description
from softfin.cli.common import Configured, Out, progress
from softfin.control.store import KIND
from softfin.plants import find_plant
from softfin.tracking.references import PAPER_RANGE
from softfin.training.engine import EngineName
from softfin.training.force_map import MapConfig
from softfin.training.gradient import differentiable
from softfin.training.jobs import Split
from softfin.training.train import STARTS


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Train force controllers inside a surrogate (paper Sec. III-C): one for all references, a grid, or gaits."""

    surrogate: tyro.conf.Positional[str]
    """Folder of the surrogate; any other plant serves too (tank, package.module:plant)."""
    out: Out
    """Folder of the controller to write."""
    controller: Literal["single", "grid", "gaits"] = "grid"
    """One policy for all references, one a cell of a grid, or a table of gaits without any net."""
    algorithm: Literal["auto", "gradient", "ppo"] = "auto"
    """Gradients through the plant, or LSTM-PPO as in the paper; auto: gradients wherever the plant has them."""
    steps: int | None = None
    """Actions a policy (by LSTM-PPO the paper's 30,000 single, 10,000 a cell)."""
    seed: int = 0
    """Of weights, exploration and references."""
    engine: EngineName = "local"
    """Where: in this process, or as tasks of Ray (extra ray), for many machines."""
    split: Split | None = None
    """Into jobs: none, one a seed, or one a cell of each seed (local: none; Ray: seed where there are several, or cell)."""
    cluster: str | None = None
    """Address HOST:PORT of the Ray cluster; by default one is started on this machine for the run."""
    resume: bool = False
    """Go on from the last checkpoint of an unfinished run."""

    def run(self) -> None:
        """Train."""
        if self.controller == "gaits":
            lattice = self.configured(MapConfig(box=PAPER_RANGE))
            with progress() as report:
                stages.gaits(self.surrogate, Path(self.out), lattice, overwrite=self.overwrite, progress=report)
            return self._tell()
        algorithm = self.algorithm
        if algorithm == "auto":
            algorithm = "gradient" if differentiable(find_plant(self.surrogate)) else "ppo"
        config = self.configured(STARTS[algorithm, self.controller], steps=self.steps)
        with progress() as report:
            stages.train(
                self.surrogate, Path(self.out), config,
                seeds=[self.seed], engine=self.engine, split=self.split, cluster=self.cluster,
                resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        return self._tell()

    def _tell(self) -> None:
        scores: list[dict[str, Any]] = load_description(Path(self.out), KIND)["scores"]
        lines = [f"{self.out}: scored in {self.surrogate}, without exploration noise"]
        if self.controller == "gaits":
            lines.append("reference [N]   mean force misses it by [N]")
            lines += [f"({x:5.2f}, {y:5.2f})   {row['missed_n']:.3f}"
                      for row in scores for x, y in [row["reference_n"]]]  # fmt: skip
        else:
            lines.append("reference [N]   error x, y [N]")
            lines += [f"({x:5.2f}, {y:5.2f})   {row['error_n'][0]:.3f}, {row['error_n'][1]:.3f}"
                      for row in scores for x, y in [row["reference_n"]]]  # fmt: skip
        self.tell({"controller": str(self.out), "scores": scores}, "\n".join(lines))
