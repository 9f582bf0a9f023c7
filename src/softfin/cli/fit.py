"""``softfin fit``: logs in, a surrogate and Table I out."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from softfin.cli.common import Configured, LogOptions, columns_read
from softfin.cli.kinds import Logs, Out
from softfin.core.choices import ModelName
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable
from softfin.data.issues import counted

if TYPE_CHECKING:
    from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Configured):
    """Learn a surrogate from logs; print Table I (paper Sec. III-B)."""

    dataset: Logs
    """Folder of a dataset, or of recordings: CSV, Parquet, ROS 2 bags."""
    out: Out
    """Folder of the surrogate to write."""
    model: ModelName = "streaming"
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
        """Refuse options that do not go with the model."""
        if self.epochs is not None and self.model != "paper":
            raise ConfigurationError(f"--epochs with --model {self.model}: only --model paper counts in epochs; see "
                                     "--set force_updates=N, or --set paper.epochs=N of --model auto")  # fmt: skip
        super().check()

    def run(self) -> None:
        """Fit."""
        from softfin.cli.tables import aligned, table_one
        from softfin.stages.fit import fit

        result = self.stage(
            fit, self.dataset, self.out, self.configured(defaults(self.model)), logs=self.recordings,
            ignore_errors=self.ignore_errors, seed=self.seed, resume=self.resume,
        )  # fmt: skip
        sys.stderr.write(printable(columns_read(result["columns"]) + warning(result["issues"], self.dataset), "\n"))
        parts = [table_one(result["table_i"])]
        if found := result["candidates"]:
            rows = [["free-running on held-out logs", "force RMSE [N]", "angle RMSE [rad]", "scored [s]", ""]]
            for name, row in found["held_out"].items():
                scores = [f"{row['force_rmse_n']:.4f}", f"{row['angle_rmse_rad']:.4f}", f"{row['seconds']:.1f}"]
                rows.append([name, *scores, "<- chosen" if name == found["chosen"] else ""])
            parts.append("\n".join(aligned(rows, (0, 4))))
        if result["caveat"] is not None:
            parts.append(f"note: {result['caveat']}")
        self.tell({"surrogate": str(self.out), **result}, "\n\n".join(parts))


def defaults(model: ModelName) -> "StreamingConfig | FitConfig | AutoConfig":
    """Return the configuration that a model is fitted with unless it is changed."""
    from softfin.surrogate import AutoConfig, FitConfig, StreamingConfig

    return StreamingConfig() if model == "streaming" else FitConfig() if model == "paper" else AutoConfig()


def warning(counts: Mapping[str, int], dataset: Path) -> str:
    """Return a line that counts what is wrong with the training logs; none where nothing is."""
    if not counts["error"] + counts["warning"]:
        return ""
    found = ", ".join(counted(count, kind) for kind, count in counts.items() if count)
    return f"{dataset}: {found}; softfin inspect {dataset} lists them\n"
