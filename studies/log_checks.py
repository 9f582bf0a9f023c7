"""Measures the checks of logs: ``python -m studies.log_checks [PUBLISHED]``.

The first table has the issues of good logs, as a whole and in pieces of 15 s: 20 of each of three
fins, and 10 of the published networks if their folder is given. The second has the ranges of the
statistics in the whole logs. The third has the issues that each fault of `tests.data.faulty` makes
in one log of each fin.
"""

import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from examples.import_keras import read_keras_surrogate
from tests.data.faulty import FAULTS, cut, log_of, recorded, tank, to_columns

from softfin.core.quantities import Log
from softfin.data.checks import signals
from softfin.data.checks.alignment import measure_rate
from softfin.data.checks.inspection import inspect
from softfin.data.checks.statistics import to_columns as read_columns
from softfin.data.importing.clocks import NamedLog

FINS = ("tank", "hand", "vehicle")

ROWS = 6000

PIECE_ROWS = 1500


def issues(log: Log) -> set[str]:
    """Return the severities and names of a log's issues."""
    found = inspect([NamedLog("log", "train", log)]).issues
    return {f"{one.severity} {one.name}" for one in found if one.name != "no test logs"}


def shares(logs: Iterable[Log]) -> str:
    """Return each issue with the number of logs that have it."""
    counts: Counter[str] = Counter()
    total = 0
    for log in logs:
        counts.update(issues(log))
        total += 1
    listed = ", ".join(f"{name} {count}" for name, count in counts.most_common())
    return f"{listed or 'none'} (of {total})"


def statistics(log: Log) -> dict[str, float]:
    """Return the statistics that are compared with thresholds."""
    one = inspect([NamedLog("log", "train", log)]).logs[0]
    columns = read_columns(log)
    moving = np.abs(measure_rate(columns.angle)) > 0.2
    drifts = [
        abs(signals.drift(force)) / force.std() for force in (columns.force_x, columns.force_y)
    ]
    return {
        "turn [degrees]": abs(one.turn_deg),
        "correlation, best axes": one.correlation,
        "correlation, shaft less mount": one.shaft_correlation - one.correlation,
        "explained, far less near lag": one.far_share - one.force_share,
        "speed over command": one.speed_ratio or np.nan,
        "velocity over rate": signals.velocity_ratio(columns.angle, columns.velocity)[1],
        "length of the fin [m]": one.fin_length_m,
        "roughness": signals.roughness(columns.force),
        "repeated": signals.repeated_share(columns.force, moving),
        "drift over deviation": max(drifts),
    }


def print_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a Markdown table."""
    print(f"\n| {' | '.join(head)} |\n|{' --- |' * len(head)}")
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def main(published: Path | None) -> None:
    """Print the tables."""
    logs = {fin: recorded(tank(fin), 20, ROWS) for fin in FINS}
    if published is not None:
        names = ("cnn_pos_net.keras", "lstm_force_net.keras", "scalers.json")
        fin = read_keras_surrogate(*(published / name for name in names))
        logs["published"] = recorded(fin, 10, ROWS)
    starts = range(0, ROWS, PIECE_ROWS)
    rows = []
    for fin, some in logs.items():
        pieces = (cut(log, start, start + PIECE_ROWS) for log in some for start in starts)
        rows.append((fin, shares(some), shares(pieces)))
    print_table(("good logs", "60 s", "15 s"), rows)
    measured = {fin: [statistics(log) for log in some] for fin, some in logs.items()}
    rows = []
    for name in measured["tank"][0]:
        values = [[one[name] for one in some] for some in measured.values()]
        rows.append((name, *(f"{min(each):.3f} .. {max(each):.3f}" for each in values)))
    print_table(("statistic", *measured), rows)
    rows = []
    for name, fault in FAULTS.items():
        cells = []
        for fin in FINS:
            columns = to_columns(logs[fin][0])
            fault(columns)
            cells.append(", ".join(sorted(issues(log_of(columns)))))
        rows.append((name, *cells))
    print_table(("fault", *FINS), rows)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
