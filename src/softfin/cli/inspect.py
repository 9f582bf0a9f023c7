"""``softfin inspect``: recordings in, all that is wrong with them out, in words."""

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from softfin.cli.common import Common, progress
from softfin.cli.kinds import Logs, Out
from softfin.cli.log_options import LogOptions
from softfin.data.checks.findings import counted


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Say what is wrong with logs before anyone trains on them; exit code 0 whatever is found."""

    logs: Logs
    """A dataset, a folder of CSV, Parquet or ROS 2 bags, or one of these."""
    out: Out | None = None
    """Folder to write inspection.json and the figure to."""

    def run(self) -> None:
        """Inspect."""
        from softfin.stages import offline as stages

        with progress() as report:
            result = stages.inspect_logs(
                self.logs, self.out, self.import_config(), overwrite=self.overwrite, progress=report
            )
        self.tell(result, table(result))


def table(result: Mapping[str, Any]) -> str:
    """The logs in a line, and each finding in a few."""
    summary = result["summary"]
    minutes = summary["rows"] / 6000
    lines = [
        f"{summary['logs']} + {summary['test_logs']} logs, {summary['rows']:,} rows at 100 Hz, {minutes:.1f} minutes",
        f"command to angle {_lag(summary['command_lag_ms'])}; angle to force {_lag(summary['force_lag_ms'])}",
    ]
    if summary["frames"] is not None:
        best = max(summary["frames"], key=summary["frames"].__getitem__)
        given = f"correlation with what a fin does {summary['frames']['x,y']:.2f}"
        lines.append(f"force axes: {given}" + ("" if best == "x,y" else f"; as {best} {summary['frames'][best]:.2f}"))
    lines.append("")
    for finding in result["findings"]:
        lines += [_head(finding), *_indented(finding["finding"])]
        lines += _indented(f"-> {finding['remedy']}") if finding["remedy"] else []
    counts = summary["counts"]
    lines.append(", ".join(counted(count, kind) for kind, count in counts.items()))
    if counts["error"]:
        lines.append("errors stop fit and import-logs, unless --accept")
    return "\n".join(lines)


def _head(finding: Mapping[str, Any]) -> str:
    place = [
        finding["log"],
        *([f"row {finding['row']}"] if finding["row"] is not None else []),
        finding["column"] or "",
    ]
    others = len(finding["logs"]) - 1
    more = f" (and {counted(others, 'more log')})" if others else ""
    return f"{finding['severity']:8} {finding['name']:16} {', '.join(filter(None, place))}{more}"


def _indented(text: str) -> list[str]:
    return textwrap.wrap(
        text, 110, initial_indent=" " * 9, subsequent_indent=" " * 9, break_long_words=False, break_on_hyphens=False
    )


def _lag(lag: Mapping[str, float] | None) -> str:
    return "not told" if lag is None else f"{lag['median']:.0f} ms ({lag['least']:.0f} .. {lag['most']:.0f})"
