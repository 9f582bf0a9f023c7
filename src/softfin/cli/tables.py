"""The paper's tables as text for a terminal."""

from collections.abc import Mapping
from typing import Any

from softfin.core.quantities import AXES
from softfin.evaluation.paper import PAPER_PRINTED_MEANS, PAPER_TABLE_II, PaperScores
from softfin.surrogate.compare.metrics import PAPER_TABLE_I

NETS = {
    "posnet": "PosNet 1D CNN",
    "forcenet_measured": "ForceNet LSTM, given the angle",
    "forcenet_free_running": "ForceNet LSTM, behind PosNet",
    "drive": "drive nets",
    "force_measured": "force nets, given the motion",
    "force_free_running": "force nets, behind drive nets",
}


def table_one(scores: dict[str, Any] | None) -> str:
    """Table I, in physical and in scaled units, beside the paper's."""
    if scores is None:
        return "no test logs: Table I has no rows"
    head = f"{'Table I':32}{'window':>7}{'parameters':>11}{'':>10}{'RMSE':>9}{'MAE':>9}{'DTW':>9}"
    lines = [head]
    for name, row in scores.items():
        title = NETS[name]
        for unit in ("physical", "scaled"):
            label = f"{title:32}{row['window'] or '-':>7}{row['parameters']:>11,}" if unit == "physical" else " " * 50
            measure = ("rad" if name in ("posnet", "drive") else "N") if unit == "physical" else "scaled"
            values = "".join(f"{row[unit][key]:>9.4f}" for key in ("rmse", "mae", "dtw_mae"))
            lines.append(f"{label}{measure:>10}{values}")
    for name, row in PAPER_TABLE_I.items():
        values = f"{row['rmse']:>9}{row['mae']:>9}{row['dtw']:>9}"
        lines.append(f"{'the paper, ' + name:32}{row['window']:>7}{row['parameters']:>11,}{'no unit':>10}{values}")
    return "\n".join(lines)


def table_two(controllers: Mapping[str, Any]) -> str:
    """Table II: error and std of the 200-sample moving average, with half of the 95% interval, beside the paper's."""
    lines = []
    for name, summary in controllers.items():
        paper = PAPER_TABLE_II.get(name, {})
        beside = f"{'the paper':>36}" if paper else ""
        lines.append(f"Table II, {name:21}{'x error':>15}{'x std':>8}{'y error':>15}{'y std':>8}{beside}")
        for row in summary["references"]:
            x, y = row["reference_n"]
            printed = paper.get((x, y))
            lines.append(f"  ({x:5.2f}, {y:5.2f}) N{'':13}{_scores(row)}{_published(printed)}{_still(row)}{held(row)}")
        complete = {tuple(row["reference_n"]) for row in summary["references"]} == set(paper)
        means = PAPER_PRINTED_MEANS[name] if paper and complete else None
        lines.append(f"  {'mean':29}{_scores(summary['mean'])}{_published(means)}")
    return "\n".join(lines)


def _scores(row: Mapping[str, Any]) -> str:
    text = ""
    for axis in AXES:
        interval = row[axis]["error_interval_n"]
        half = "" if interval is None else f" ±{(interval[1] - interval[0]) / 2:.2f}"
        text += f"{row[axis]['error_n']:.3f}{half}".rjust(15) + f"{row[axis]['std_n']:8.3f}"
    return text


def _published(scores: PaperScores | None) -> str:
    return "" if scores is None else "    " + "".join(f"{value:8.3f}" for value in scores)


def held(row: Mapping[str, Any]) -> str:
    """Where another force is held than was asked for."""
    held = row.get("tracked_reference_n") or row["held_n"]
    if max(abs(a - b) for a, b in zip(held, row["reference_n"], strict=True)) < 1e-3:
        return ""
    return f"  cannot be made: ({held[0]:.2f}, {held[1]:.2f}) N is held"


def _still(row: Mapping[str, Any]) -> str:
    return "  stands still" if row["still"] else ""


def choice(candidates: Mapping[str, Any]) -> str:
    """What the candidates leave on held-out logs."""
    head = f"{'free-running on held-out logs':32}{'force RMSE [N]':>18}{'angle RMSE [rad]':>18}{'scored [s]':>12}"
    lines = [head]
    for name, row in candidates["held_out"].items():
        chosen = "  <- chosen" if name == candidates["chosen"] else ""
        lines.append(
            f"{name:32}{row['force_rmse_n']:>18.4f}{row['angle_rmse_rad']:>18.4f}{row['seconds']:>12.1f}{chosen}"
        )
    lines += [f"{name:32}not fitted: {why}" for name, why in candidates["left_out"].items()]
    return "\n".join(lines)
