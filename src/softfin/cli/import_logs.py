"""``softfin import-logs``: recordings of any kind in, a dataset out."""

from dataclasses import dataclass

from softfin.cli.common import Common, LogOptions, columns_read
from softfin.cli.kinds import Logs, Out
from softfin.data.issues import counted


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
        from softfin.stages.logs import import_logs

        data, inspection = self.stage(
            import_logs, self.logs, self.out, self.recordings, ignore_errors=self.ignore_errors
        )
        summary = inspection.summary()
        counts = ", ".join(counted(count, kind) for kind, count in summary["counts"].items())
        logs = f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows; {counts}"
        self.tell(
            {"dataset": str(self.out), **summary, "data_hash": data.data_hash},
            f"{columns_read(summary['columns'])}{self.out}: {logs}",
        )
