"""``softfin inspect``: recordings in, a list of what is wrong with them out."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softfin.cli.common import Common, LogOptions
from softfin.cli.kinds import Logs, Out
from softfin.data.issues import counted


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Check logs before anyone trains on them; exit code 0 whatever is found."""

    logs: Logs
    """A dataset, a folder of CSV, Parquet or ROS 2 bags, or one of these."""
    out: Out | None = None
    """Folder to write inspection.json and the figure to."""

    def run(self) -> None:
        """Inspect."""
        from softfin.stages.logs import inspect_logs

        result = self.stage(inspect_logs, self.logs, self.out, self.recordings)
        self.tell(result, table(result))


def table(result: Mapping[str, Any]) -> str:
    """Return the logs in a line, and each issue in a few."""
    summary, counts = result["summary"], result["summary"]["counts"]
    lines = [
        f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows at 100 Hz, "
        f"{summary['rows'] / 6000:.1f} minutes",
        f"command to angle {_lag(summary['command_lag_ms'])}; angle to force {_lag(summary['force_lag_ms'])}",
    ]
    if (frames := summary["frames"]) is not None:
        best = max(frames, key=frames.__getitem__)
        other = "" if best == "x,y" else f"; as {best} {frames[best]:.2f}"
        lines.append(f"force axes: correlation with a model fin {frames['x,y']:.2f}{other}")
    lines.append("")
    for issue in result["issues"]:
        row, others = issue["row"], len(issue["logs"]) - 1
        place = [issue["log"], "" if row is None else f"row {row}", issue["column"] or ""]
        more = f" (and {counted(others, 'more log')})" if others else ""
        lines.append(f"{issue['severity']:8} {issue['name']:16} {', '.join(filter(None, place))}{more}")
        for text in (issue["message"], f"-> {issue['fix']}" if issue["fix"] else ""):
            wrapped = textwrap.wrap(text, 101, break_long_words=False, break_on_hyphens=False)
            lines += [" " * 9 + line for line in wrapped]
    lines.append(", ".join(counted(count, kind) for kind, count in counts.items()))
    if counts["error"]:
        lines.append("errors stop fit and import-logs, unless --ignore-errors")
    return "\n".join(lines)


def _lag(lag: Mapping[str, float] | None) -> str:
    return "not known" if lag is None else f"{lag['median']:.0f} ms ({lag['least']:.0f} .. {lag['most']:.0f})"
