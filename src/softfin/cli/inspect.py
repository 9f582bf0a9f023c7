"""``softfin inspect``: recordings in, all that is wrong with them out."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softfin.cli.common import Common, progress
from softfin.cli.kinds import Logs, Out
from softfin.cli.log_options import LogOptions
from softfin.data.issues import counted


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Find what is wrong with logs before training on them; exit code 0 whatever is found."""

    logs: Logs
    """A dataset, a folder of CSV, Parquet or ROS 2 bags, or one of these."""
    out: Out | None = None
    """Folder to write inspection.json and the figure to."""

    def run(self) -> None:
        """Inspect."""
        from softfin.stages.logs import inspect_logs

        with progress() as report:
            result = inspect_logs(self.logs, self.out, self.import_config(), overwrite=self.overwrite, progress=report)
        self.tell(result, table(result))


def table(result: Mapping[str, Any]) -> str:
    """Text of an inspection: the logs in a line, and each issue in a few."""
    summary = result["summary"]
    minutes = summary["rows"] / 6000
    lines = [
        f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows at 100 Hz, {minutes:.1f} minutes",
        f"command to angle {_lag(summary['command_lag_ms'])}; angle to force {_lag(summary['force_lag_ms'])}",
    ]
    if summary["frames"] is not None:
        best = max(summary["frames"], key=summary["frames"].__getitem__)
        given = f"correlation with a model fin {summary['frames']['x,y']:.2f}"
        lines.append(f"force axes: {given}" + ("" if best == "x,y" else f"; as {best} {summary['frames'][best]:.2f}"))
    lines.append("")
    for issue in result["issues"]:
        lines += [_head(issue), *_indented(issue["message"])]
        lines += _indented(f"-> {issue['fix']}") if issue["fix"] else []
    counts = summary["counts"]
    lines.append(", ".join(counted(count, kind) for kind, count in counts.items()))
    if counts["error"]:
        lines.append("errors stop fit and import-logs, unless --ignore-errors")
    return "\n".join(lines)


def _head(issue: Mapping[str, Any]) -> str:
    place = [
        issue["log"],
        *([f"row {issue['row']}"] if issue["row"] is not None else []),
        issue["column"] or "",
    ]
    others = len(issue["logs"]) - 1
    more = f" (and {counted(others, 'more log')})" if others else ""
    return f"{issue['severity']:8} {issue['name']:16} {', '.join(filter(None, place))}{more}"


def _indented(text: str) -> list[str]:
    return textwrap.wrap(
        text, 110, initial_indent=" " * 9, subsequent_indent=" " * 9, break_long_words=False, break_on_hyphens=False
    )


def _lag(lag: Mapping[str, float] | None) -> str:
    return "not known" if lag is None else f"{lag['median']:.0f} ms ({lag['least']:.0f} .. {lag['most']:.0f})"
