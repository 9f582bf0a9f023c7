"""``softfin evaluate``: a controller and a plant in, Table II and figures out."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from softfin import stages
from softfin.cli.common import Configured, Out
from softfin.cli.tables import table_two
from softfin.errors import ConfigurationError
from softfin.evaluation.evaluate import EvaluateConfig


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Judge a controller on a fin over reference forces (paper Sec. IV-B, Table II)."""

    controller: tyro.conf.Positional[Path]
    """Folder of the controller."""
    out: Out
    """Folder to write evaluation.json and the figures to."""
    plant: str = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    reference: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Reference force as --reference=X,Y in newton, once for each (the paper's six)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Of the plant's noise (0)."""

    def run(self) -> None:
        """Evaluate."""
        references = [force(text) for text in self.reference] or None
        config = self.configured(
            EvaluateConfig(), references=references, seconds=self.seconds, seeds=self.seeds, seed=self.seed
        )
        summary = stages.evaluate(self.controller, self.plant, Path(self.out), config, overwrite=self.overwrite)
        table = table_two({stages.kind_of(self.controller): summary})
        self.tell(summary, table if summary["warning"] is None else f"{table}\nwarning: {summary['warning']}")


def force(text: str) -> tuple[float, float]:
    """A reference force as it stands on the command line."""
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise ConfigurationError(f"--reference={text}: not a force; write --reference=X,Y in newton, as 1,-1") from None
    return x, y
