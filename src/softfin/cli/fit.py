"""``softfin fit``: logs in, a surrogate and Table I out."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import Logs, Out
from softfin.cli.log_options import LogOptions, columns_read
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable

if TYPE_CHECKING:
    from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig

Model: TypeAlias = Literal["streaming", "paper", "auto"]
"""Kinds of surrogate that are fitted; auto keeps the best on held-out logs."""


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Configured):
    """Learn a surrogate from logs; print Table I (paper Sec. III-B)."""

    dataset: Logs
    """Folder of a dataset, or of recordings: CSV, Parquet, ROS 2 bags."""
    out: Out
    """Folder of the surrogate to write."""
    model: Model = "streaming"
    """streaming: an ensemble of recurrent nets; paper: PosNet and ForceNet; auto: both, of which the
    best on held-out logs is kept."""
    ignore_errors: bool = False
    """Take logs with errors, too."""
    epochs: int | None = None
    """Most passes over the data, of --model paper."""
    seed: int = 0
    """Seed of weights, order and dropout."""
    resume: bool = False
    """Go on from the last checkpoint of an unfinished run."""

    def check(self) -> None:
        """Whether the options go with the model."""
        if self.epochs is not None and self.model != "paper":
            raise ConfigurationError(f"--epochs with --model {self.model}: only --model paper counts in epochs; see "
                                     "--set force_updates=N, or --set paper.epochs=N of --model auto")  # fmt: skip
        super().check()

    def run(self) -> None:
        """Fit."""
        from softfin.cli.tables import choice, table_one
        from softfin.stages import offline as stages

        config = self.configured(defaults(self.model), epochs=self.epochs)
        with progress() as report:
            result = stages.fit(
                self.dataset, Path(self.out), config, logs=self.import_config(), ignore_errors=self.ignore_errors,
                seed=self.seed, resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        sys.stderr.write(printable(columns_read(result["columns"]) + warning(result["issues"], self.dataset), "\n"))
        parts = [table_one(result["table_i"]), *([choice(result["candidates"])] if result["candidates"] else [])]
        if result["caveat"] is not None:
            parts.append(f"note: {result['caveat']}")
        self.tell({"surrogate": str(self.out), **result}, "\n\n".join(parts))


def defaults(model: Model) -> "StreamingConfig | FitConfig | AutoConfig":
    """The configuration that a model is fitted with unless it is changed."""
    from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig

    kinds: dict[Model, type[StreamingConfig | FitConfig | AutoConfig]] = {
        "streaming": StreamingConfig, "paper": FitConfig, "auto": AutoConfig
    }  # fmt: skip
    return kinds[model]()


def warning(counts: Mapping[str, int], dataset: Path) -> str:
    """A line that says how much is wrong with the logs that were learnt from; none where nothing is."""
    from softfin.data.issues import counted

    if not counts["error"] + counts["warning"]:
        return ""
    found = ", ".join(counted(count, kind) for kind, count in counts.items() if count)
    return f"{dataset}: {found}; softfin inspect {dataset} says which\n"
