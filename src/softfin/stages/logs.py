"""Stages that check recordings, import them as a dataset, or recover them. No JAX."""

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import yaml

from softfin.core.json_object import JsonObject
from softfin.core.option_types import DIR, FILE, HIDDEN, LOGS, RECORDING, RECORDINGS, PathLike
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.data.importing.importing import ImportConfig, format_options
from softfin.data.issues import counted
from softfin.storage import artifact as artifacts
from softfin.storage.paths import find_recordings, typed_path


def inspect_logs(
    logs: Annotated[PathLike, LOGS],
    *,
    out: Annotated[PathLike | None, DIR] = None,
    recordings: Annotated[ImportConfig | None, RECORDINGS] = None,
    save: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Check logs before you train on them. The exit code is 0 even if errors are found.

    Args:
        logs: A dataset, a single log, or a folder of CSV files, Parquet files or ROS 2 bags.
        out: Output folder for inspection.json and the figure.
        recordings: How to read recordings that softfin did not make.
        save: Save these options as log.yaml next to the logs, where other commands find them.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        The contents of inspection.json: issues, and a summary of the logs.

    Example:
        >>> print(softfin.inspect_logs("recordings"))
    """
    logs = Path(logs)
    find_recordings(logs)
    if out is not None:
        artifacts.check_vacant(Path(out), overwrite, kind="inspection")
    from softfin.data.recordings import ignoring, open_logs, options_file

    opened = open_logs(logs, recordings, progress)
    if save:
        options = opened.config.model_dump(mode="json", exclude_defaults=True)
        artifacts.write_file(options_file(logs), yaml.safe_dump(options, allow_unicode=True))
    metadata = {
        "source": str(logs),
        "options": opened.config.model_dump(mode="json"),
        "provenance": artifacts.provenance(data_hash=opened.data_hash),
    }
    if out is None:
        values = {**opened.inspection.to_dict(), **metadata}
    else:
        # Imported here because importing Matplotlib takes time.
        from softfin.data.checks.report import write_inspection

        values = write_inspection(opened.inspection, opened.logs, Path(out), metadata, overwrite)
    errors = opened.remaining_errors()
    if errors:
        text = f"fit and import-logs reject logs with errors unless you add {ignoring(errors)}"
    else:
        words = [typed_path(logs), format_options(opened.config), "--out surrogate"]
        text = f"next: softfin fit {' '.join(filter(None, words))}"
    return Result(values, f"{inspection_table(values)}\n{text}")


def import_logs(
    logs: Annotated[PathLike, LOGS],
    *,
    out: Annotated[PathLike, DIR],
    recordings: Annotated[ImportConfig | None, RECORDINGS] = None,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Convert CSV files, Parquet files or ROS 2 bags into a 100 Hz dataset. Logs with errors are
    rejected.

    Args:
        logs: A recording, or a folder of recordings.
        out: Dataset folder to write.
        recordings: How to read recordings from other programs.
        overwrite: Replace existing output.
        progress: Function that is called with the progress.

    Returns:
        Folder and hash of the dataset, and a summary of the logs.

    Raises:
        LogError: If the logs have errors and ignore_errors is not set.

    Example:
        >>> softfin.import_logs("recordings", out="dataset")
    """
    logs = Path(logs)
    out = Path(out)
    find_recordings(logs)
    artifacts.check_vacant(out, overwrite, kind="dataset")
    from softfin.data.recordings import open_logs
    from softfin.storage.dataset import write_dataset

    opened = open_logs(logs, recordings, progress)
    opened.check_train(str(logs))
    opened.check_issues(str(logs))
    metadata = {
        **opened.metadata,
        "provenance": artifacts.provenance(),
    }
    data = write_dataset(out, opened.train, opened.test, metadata, overwrite)
    summary = opened.inspection.summary()
    return Result(
        {"dataset": str(out), **summary, "data_hash": data.data_hash},
        f"{columns_read(summary['columns'])}{out}: {summary['logs']} + {summary['test_logs']} "
        f"logs, {summary['rows']:,} rows; {issue_counts(summary['counts'])}",
    )


def recover_recording(
    recording: Annotated[PathLike, RECORDING],
    *,
    out: Annotated[PathLike | None, FILE] = None,
    overwrite: bool = False,
) -> Result:
    """Recover the readings from a truncated or damaged recording.

    Args:
        recording: File to recover (.mcap).
        out: File to write (default: NAME.recovered.mcap).
        overwrite: Replace an existing file.

    Returns:
        File that was written (None if the recording is not damaged), number of messages, and
        what could not be read.

    Example:
        >>> softfin.recover_recording("run.mcap")
    """
    from softfin.storage.bag.recovery import recover, recovered_path

    recording = Path(recording)
    out = recovered_path(recording) if out is None else Path(out)
    recovery = recover(recording, out, overwrite)
    if not recovery.damages:
        return Result(
            {"recovered": None, **recovery.to_dict()},
            f"{recording}: not damaged; use the recording as it is, because no file was written",
        )
    messages = counted(sum(recovery.messages.values()), "message")
    reasons = "; ".join(f"byte {at:,}: {reason}" for at, reason in recovery.damages)
    return Result(
        {"recovered": str(out), **recovery.to_dict()},
        f"{out}: {messages} recovered; damaged at {reasons[:300]}",
    )


def columns_read(columns: Mapping[str, str]) -> str:
    """Return one line per log on the interpretation of columns without softfin's names."""
    return "".join(f"{log}: {text}\n" for log, text in columns.items())


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
    return "\n".join(lines)


def _issue_lines(issue: JsonObject) -> list[str]:
    """Return the location of an issue, followed by its message and fix, indented."""
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
