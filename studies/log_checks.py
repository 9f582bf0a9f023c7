"""Measures the checks of logs: ``python -m studies.log_checks``.

The first table has the issues of good logs: 20 of each of three fins, as a whole and in pieces of
15 s. The second has the issues that each fault of `tests.data.faulty` makes in one log of each fin.
"""

from collections import Counter
from collections.abc import Iterable

from tests.data.faulty import FAULTS, cut, log_of, recorded, tank, to_columns

from softfin.core.quantities import Log
from softfin.data.checks.inspection import inspect
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


def main() -> None:
    """Print both tables."""
    logs = {fin: recorded(tank(fin), 20, ROWS) for fin in FINS}
    print("| good logs | 60 s | 15 s |\n| --- | --- | --- |")
    for fin in FINS:
        starts = range(0, ROWS, PIECE_ROWS)
        pieces = (cut(log, start, start + PIECE_ROWS) for log in logs[fin] for start in starts)
        print(f"| {fin} | {shares(logs[fin])} | {shares(pieces)} |", flush=True)
    print(f"\n| fault | {' | '.join(FINS)} |\n| --- |{' --- |' * len(FINS)}")
    for name, fault in FAULTS.items():
        cells = []
        for fin in FINS:
            columns = to_columns(logs[fin][0])
            fault(columns)
            cells.append(", ".join(sorted(issues(log_of(columns)))))
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
