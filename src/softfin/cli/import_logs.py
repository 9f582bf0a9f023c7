"""``softfin import-logs``: recordings of any kind in, a dataset out."""

from dataclasses import dataclass
from pathlib import Path

from softfin.cli.common import Common, progress
from softfin.cli.kinds import Logs, Out
from softfin.cli.log_options import LogOptions, columns_read


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Turn CSV, Parquet or ROS 2 bags into a dataset at 100 Hz; stop where inspect finds errors."""

    logs: Logs
    """A folder of recordings, or one."""
    out: Out
    """Folder of the dataset to write."""
    ignore_errors: bool = False
    """Take logs with errors, too."""

    def run(self) -> None:
        """Import."""
        from softfin.data.issues import counted
        from softfin.stages.logs import import_logs

        with progress() as report:
            data, inspection = import_logs(
                self.logs, Path(self.out), self.import_config(),
                ignore_errors=self.ignore_errors, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        summary = inspection.summary()
        counts = ", ".join(counted(count, kind) for kind, count in summary["counts"].items())
        result = {"dataset": str(self.out), **summary, "data_hash": data.data_hash}
        logs = f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows; {counts}"
        self.tell(result, f"{columns_read(summary['columns'])}{self.out}: {logs}")
