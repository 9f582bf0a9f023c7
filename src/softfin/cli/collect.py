"""``softfin collect``: a plant in, a dataset out."""

from dataclasses import dataclass
from pathlib import Path

from softfin import stages
from softfin.cli.common import Configured, Out, progress
from softfin.logs.collect import CollectConfig


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Record random motions of a fin and its force as a dataset (paper Sec. III-A)."""

    out: Out
    """Folder of the dataset to write."""
    plant: str = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    logs: int | None = None
    """Logs to learn from (the paper's 100)."""
    test_logs: int | None = None
    """Logs to score on, under other conditions (the paper's 3)."""
    rows: int | None = None
    """Readings a log at 100 Hz (the paper's 20,000)."""
    seed: int | None = None
    """Of commands, noise and conditions (0)."""

    def run(self) -> None:
        """Collect."""
        config = self.configured(
            CollectConfig(), logs=self.logs, test_logs=self.test_logs, rows=self.rows, seed=self.seed
        )
        with progress() as report:
            data = stages.collect(self.plant, Path(self.out), config, overwrite=self.overwrite, progress=report)
        counts = {"logs": len(data.train), "test_logs": len(data.test), "rows": config.rows}
        result = {"dataset": str(self.out), **counts, "data_hash": data.data_hash}
        self.tell(result, f"{self.out}: {counts['logs']} + {counts['test_logs']} logs of {config.rows:,} rows")
