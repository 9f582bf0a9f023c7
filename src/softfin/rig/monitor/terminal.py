"""View of a recording in the terminal, 80 columns by 24 lines; only the final state if the output
is piped."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float64
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from softfin.core.printable import printable
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.summary import MAX_NUMBER, STATES, Summary, Trace, counts

SHOWN_S = 20.0
"""Time span of the traces [s]."""

TRACE_COLUMNS = 20
"""Number of characters in a trace: one per second."""

BLOCKS = "▁▂▃▄▅▆▇█"

COLOURS = {"recording": "bold green", "silent": "bold yellow", "damaged": "bold red"}


def watch(follower: Follower, console: Console, *, sleep: Callable[[float], None]) -> None:
    """Show a recording until it ends; for a folder, continue with newer recordings indefinitely."""
    try:
        with Live(console=console, auto_refresh=False, vertical_overflow="crop") as live:
            while True:
                follower.poll()
                summary = follower.summary()
                live.update(render(summary, follower.traces), refresh=True)
                if summary["state"] in ("ended", "damaged") and not follower.follows_folder:
                    return
                sleep(0.25)
    finally:
        if not console.is_terminal:
            console.line()


def render(summary: Summary, traces: Mapping[str, Trace]) -> Group:
    """Return the complete screen."""
    state = summary["state"]
    path = summary["path"]
    age = summary["age_s"]
    at = "" if summary["time_s"] is None else f", {summary['time_s']:.1f} s"
    at += f", latest {age:.0f} s ago" if state == "silent" and age is not None else ""
    events = [_line(f"{event_time:9.2f} s  {text}") for event_time, text in summary["events"][-6:]]
    return Group(
        # The end of a path is more informative than its beginning.
        _line(path if len(path) <= 79 else "…" + path[-78:]),
        _line(STATES[state] + at, COLOURS.get(state, "bold"), wrap=True),
        Text(),
        _table(summary, traces),
        Text(),
        _line(counts(summary)),
        *([_line(summary["problem"], "red", wrap=True)] if summary["problem"] else []),
        Text(),
        *(events or [_line("no events yet", "dim")]),
    )


def _table(summary: Summary, traces: Mapping[str, Trace]) -> Table:
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    last = f"last {SHOWN_S:.0f} s"
    for title in ("", "now", "2 s mean", "target", "min", last, "max"):
        table.add_column(title, justify="left" if title in ("", last) else "right", no_wrap=True)
    pairs = [summary[name] or (None, None) for name in ("force_n", "mean_force_n", "reference_n")]
    rows = [
        ("angle [rad]", "joint", 1, (summary["angle_rad"], None, summary["command_angle_rad"])),
        ("velocity [rad/s]", "joint", 2, (summary["velocity_rad_s"], None, None)),
        ("force x [N]", "wrench", 1, [x for x, _ in pairs]),
        ("force y [N]", "wrench", 2, [y for _, y in pairs]),
        ("torque [N m]", "wrench", 3, (summary["torque_nm"], None, None)),
        ("current [A]", "current", 1, (summary["current_a"], None, None)),
    ]
    for name, role, column, numbers in rows:
        values = traces[role].array()
        table.add_row(
            Text(name), *map(_number, numbers), *sparkline(values[:, 0], values[:, column])
        )
    return table


def sparkline(
    times: Float64[np.ndarray, " rows"], values: Float64[np.ndarray, " rows"]
) -> tuple[str, str, str]:
    """Return minimum, trace and maximum; the trace has one character per time bin for its mean, and
    a space if rows are missing."""
    shown = (np.abs(values) < MAX_NUMBER) & (times > (times.max(initial=0.0) - SHOWN_S))
    times = times[shown]
    values = values[shown]
    if not len(times):
        return "-", " " * TRACE_COLUMNS, "-"
    low = float(values.min())
    high = float(values.max())
    # Bin 0 starts SHOWN_S before the latest row.
    bins = np.clip(
        ((times - times.max() + SHOWN_S) * TRACE_COLUMNS / SHOWN_S).astype(int),
        0,
        TRACE_COLUMNS - 1,
    )
    filled = np.bincount(bins, minlength=TRACE_COLUMNS)
    # Sum divided by count; empty bins are drawn as spaces.
    means = np.bincount(bins, values, TRACE_COLUMNS) / np.maximum(filled, 1)
    heights = np.zeros(TRACE_COLUMNS) if high == low else (means - low) / (high - low)
    indices = np.clip((heights * len(BLOCKS)).astype(int), 0, len(BLOCKS) - 1)
    letters = (
        BLOCKS[index] if count else " " for index, count in zip(indices, filled, strict=True)
    )
    return _number(low), "".join(letters), _number(high)


def _line(text: str, style: str = "", wrap: bool = False) -> Text:
    return Text(
        printable(text), style=style, no_wrap=not wrap, overflow="fold" if wrap else "ellipsis"
    )


def _number(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2e}" if abs(value) >= 1e4 else f"{value + 0.0:.2f}".replace("-0.00", "0.00")
