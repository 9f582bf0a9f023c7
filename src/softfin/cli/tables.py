"""The paper's tables as text for a terminal."""

from typing import Any

from softfin.surrogate.metrics import PAPER_TABLE_I

NETS = {
    "posnet": "PosNet 1D CNN",
    "forcenet_measured": "ForceNet LSTM, given the angle",
    "forcenet_free_running": "ForceNet LSTM, behind PosNet",
}


def table_one(scores: dict[str, Any] | None) -> str:
    """Table I, in physical and in scaled units, beside the paper's."""
    if scores is None:
        return "no test logs: Table I has no rows"
    head = f"{'Table I':32}{'window':>7}{'parameters':>11}{'':>10}{'RMSE':>9}{'MAE':>9}{'DTW rms':>9}{'DTW mae':>9}"
    lines = [head]
    for name, title in NETS.items():
        row = scores[name]
        for unit in ("physical", "scaled"):
            label = f"{title:32}{row['window']:>7}{row['parameters']:>11,}" if unit == "physical" else " " * 50
            measure = ("rad" if name == "posnet" else "N") if unit == "physical" else "scaled"
            values = "".join(f"{row[unit][key]:>9.4f}" for key in ("rmse", "mae", "dtw_rms", "dtw_mae"))
            lines.append(f"{label}{measure:>10}{values}")
    for name, row in PAPER_TABLE_I.items():
        values = f"{row['rmse']:>9}{row['mae']:>9}{row['dtw']:>9}"
        lines.append(f"{'the paper, ' + name:32}{row['window']:>7}{row['parameters']:>11,}{'no unit':>10}{values}")
    return "\n".join(lines)
