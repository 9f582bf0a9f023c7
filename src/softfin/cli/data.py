"""Commands for logs: ``collect``, ``inspect``, ``import-logs`` and ``bag``."""

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

from softfin.cli.common import (
    AnyPlant,
    Armed,
    Common,
    Configured,
    File,
    LogOptions,
    Logs,
    Out,
    progress,
)
from softfin.cli.options import Option
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.data.issues import counted
from softfin.storage.registry import is_live


class CollectArguments(Armed, Configured):
    """Record random fin motions and the resulting forces as a dataset (paper Sec. III-A)."""

    out: Out
    """Dataset folder to write."""
    plant: AnyPlant = "tank"
    """The fin. Simulated: tank, a tank's YAML file, a surrogate's folder, or package.module:plant.
    Real: rig or ros2, optionally followed by :FILE."""
    logs: int | None = None
    """Number of training logs (default: 100, as in the paper)."""
    test_logs: int | None = None
    """Number of test logs, each in a perturbed tank (default: 3, as in the paper)."""
    rows: int | None = None
    """Readings per log, at 100 Hz (default: 20000, as in the paper)."""
    seed: int | None = None
    """Seed for commands, noise and conditions (default: 0)."""
    resume: bool = False
    """Continue after the last complete log (real fins only)."""

    def check(self) -> None:
        """Reject options that do not apply to the plant."""
        super().check()
        if is_live(self.plant):
            return
        for option, is_given in (("--arm", self.arm), ("--resume", self.resume)):
            if is_given:
                raise ConfigurationError(
                    f"{option}: {self.plant} is simulated; omit {option}, or use --plant rig"
                )

    def __call__(self) -> None:
        from softfin.cli.driving import KeyboardStop, say
        from softfin.data.collect import CollectConfig
        from softfin.stages.collect import collect
        from softfin.stages.live import collect_live
        from softfin.stages.machines import find_robot

        config = self.configured(CollectConfig())
        if is_live(self.plant):
            robot = find_robot(self.plant)
            keys = KeyboardStop(self.confirm)
            with progress() as report:
                data = collect_live(
                    robot,
                    self.out,
                    config,
                    keys.confirm,
                    resume=self.resume,
                    stop=keys.stop,
                    warn=say,
                    overwrite=self.overwrite,
                    progress=report,
                )
        else:
            with progress() as report:
                data = collect(
                    self.plant, self.out, config, overwrite=self.overwrite, progress=report
                )
        counts = {"logs": len(data.train), "test_logs": len(data.test), "rows": config.rows}
        self.tell(
            {"dataset": str(self.out), **counts, "data_hash": data.data_hash},
            f"{self.out}: {config.logs} + {config.test_logs} logs of {config.rows:,} rows",
        )


class InspectArguments(LogOptions, Common):
    """Check logs before you train on them. The exit code is 0 even if errors are found."""

    logs: Logs
    """A dataset, a single log, or a folder of CSV files, Parquet files or ROS 2 bags."""
    out: Out | None = None
    """Output folder for inspection.json and the figure."""

    def __call__(self) -> None:
        from softfin.stages.logs import inspect_logs

        with progress() as report:
            result = inspect_logs(
                self.logs, self.out, self.recordings, overwrite=self.overwrite, progress=report
            )
        self.tell(result, inspection_table(result))


def inspection_table(result: JsonObject) -> str:
    """Return a summary of the logs, followed by each issue."""
    summary = result["summary"]
    counts = summary["counts"]
    lines = [
        f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows at 100 Hz, "
        f"{summary['rows'] / 6000:.1f} minutes",
        f"command to angle {_lag(summary['command_lag_ms'])}; "
        f"angle to force {_lag(summary['force_lag_ms'])}",
    ]
    if (frames := summary["frames"]) is not None:
        best = max(frames, key=frames.__getitem__)
        other = "" if best == "x,y" else f"; as {best} {frames[best]:.2f}"
        lines.append(f"force axes: correlation with a model fin {frames['x,y']:.2f}{other}")
    for channel, (low, high) in summary["channels"].items():
        lines.append(f"channel {channel}: {low:.3g} .. {high:.3g}")
    lines.append("")
    for issue in result["issues"]:
        lines += _issue_lines(issue)
    lines.append(issue_counts(counts))
    if counts["error"]:
        lines.append("fit and import-logs reject logs with errors unless you add --ignore-errors")
    return "\n".join(lines)


def _issue_lines(issue: JsonObject) -> list[str]:
    """Return the location of an issue, then its message and its fix, indented."""
    row = issue["row"]
    others = len(issue["logs"]) - 1
    place = [issue["log"], "" if row is None else f"row {row}", issue["column"] or ""]
    more = f" (and {counted(others, 'more log')})" if others else ""
    lines = [f"{issue['severity']:8} {issue['name']:16} {', '.join(filter(None, place))}{more}"]
    for text in (issue["message"], issue["fix"] and f"-> {issue['fix']}"):
        lines += textwrap.wrap(
            text or "",
            110,
            initial_indent=" " * 9,
            subsequent_indent=" " * 9,
            break_long_words=False,
            break_on_hyphens=False,
        )
    return lines


def _lag(lag: Mapping[str, float] | None) -> str:
    if lag is None:
        return "unknown"
    return f"{lag['median']:.0f} ms ({lag['least']:.0f} .. {lag['most']:.0f})"


def issue_counts(counts: Mapping[str, int]) -> str:
    """Return the number of issues of each severity, as text."""
    return ", ".join(counted(count, kind) for kind, count in counts.items())


class ImportLogsArguments(LogOptions, Common):
    """Convert CSV files, Parquet files or ROS 2 bags into a 100 Hz dataset. Logs with errors are
    rejected."""

    logs: Logs
    """A recording, or a folder of recordings."""
    out: Out
    """Dataset folder to write."""
    ignore_errors: bool = False
    """Also import logs with errors."""

    def __call__(self) -> None:
        from softfin.stages.logs import import_logs

        with progress() as report:
            data, inspection = import_logs(
                self.logs,
                self.out,
                self.recordings,
                ignore_errors=self.ignore_errors,
                overwrite=self.overwrite,
                progress=report,
            )
        summary = inspection.summary()
        self.tell(
            {"dataset": str(self.out), **summary, "data_hash": data.data_hash},
            f"{self.columns_read(summary['columns'])}{self.out}: {summary['logs']} + "
            f"{summary['test_logs']} logs, "
            f"{summary['rows']:,} rows; {issue_counts(summary['counts'])}",
        )


class BagRecoverArguments(Common):
    """Recover the readings from a truncated or damaged recording."""

    path: Annotated[Path, Option("RECORDING", positional=True)]
    """File to recover (.mcap)."""
    out: File | None = None
    """File to write (default: NAME.recovered.mcap)."""

    def __call__(self) -> None:
        from softfin.storage.bag.recovery import recover, recovered_path

        out = self.out or recovered_path(self.path)
        recovery = recover(self.path, out, self.overwrite)
        messages = counted(sum(recovery.messages.values()), "message")
        reasons = "; ".join(f"byte {at:,}: {reason}" for at, reason in recovery.damages)
        state = f"damaged at {reasons[:300]}" if reasons else "not damaged"
        self.tell(
            {"recovered": str(out), **recovery.to_dict()},
            f"{out}: {messages} recovered; {state}",
        )
