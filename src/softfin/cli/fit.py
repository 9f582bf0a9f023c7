"""``softfin fit``: a dataset in, a surrogate and Table I out."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from softfin import stages
from softfin.cli.common import Configured, Out, progress
from softfin.cli.tables import table_one
from softfin.surrogate import FitConfig


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Learn a surrogate, PosNet and ForceNet, from a dataset; print Table I (paper Sec. III-B)."""

    dataset: tyro.conf.Positional[Path]
    """Folder of the dataset."""
    out: Out
    """Folder of the surrogate to write."""
    epochs: int | None = None
    """Most passes over the data."""
    seed: int = 0
    """Of weights, order and dropout."""
    resume: bool = False
    """Go on from the last checkpoint of an unfinished run."""

    def run(self) -> None:
        """Fit."""
        config = self.configured(FitConfig(), epochs=self.epochs)
        with progress() as report:
            result = stages.fit(
                self.dataset, Path(self.out), config,
                seed=self.seed, resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        self.tell({"surrogate": str(self.out), **result}, table_one(result["table_i"]))
