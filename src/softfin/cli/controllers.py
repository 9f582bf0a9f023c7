"""Commands that produce or export controllers: ``map``, ``train`` and ``export``."""

import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

from softfin.cli.common import (
    Common,
    Configured,
    ControllerFolder,
    File,
    Out,
    plant,
    progress,
)
from softfin.cli.options import Option
from softfin.core.choices import PolicyLayout, TrainingRangeName
from softfin.core.json_object import JsonObject

if TYPE_CHECKING:
    from softfin.core.action_clock import ActionClock


AUTO = "auto"
"""Value of --clock: the clock for the fin's stroke time."""

MAX_ERROR_SHARE = 0.5
"""Largest error of a useful controller, divided by its target forces."""


class MapArguments(Configured):
    """Find the mean forces that a fin can produce, and gaits that produce them: a controller."""

    plant: Annotated[str, plant(positional=True)]
    """Surrogate folder, or another plant: tank or package.module:plant."""
    out: Out
    """Controller folder to write: the gaits, the forces that they produce, and a figure."""
    clock: Annotated[str, Option("HZ[,S]")] | None = None
    """Clock: actions per second and window [s], e.g. 6,1; auto: from the fin's stroke time
    (default: paper, which is 3,2)."""

    def check(self) -> None:
        """Reject a clock that does not exist."""
        check_clock(self.clock)
        super().check()

    def __call__(self) -> None:
        from softfin.gaits.force_map import MapConfig
        from softfin.gaits.reachable import force_decimals
        from softfin.stages.controllers import map_forces

        config = self.configured(MapConfig(clock=asked_clock(self.clock, self.plant)))
        with progress() as report:
            summary = map_forces(
                self.plant, self.out, config, overwrite=self.overwrite, progress=report
            )
        # Adding 0 turns -0.0 into 0.
        decimals = force_decimals(summary["reach_n"])
        (x0, y0), (x1, y1) = (
            tuple(round(x, decimals) + 0.0 for x in corner) for corner in summary["box_n"]
        )
        beyond = ", ".join(f"({x:g}, {y:g})" for x, y in summary["beyond"]) or "none"
        warning = "" if summary["warning"] is None else f"\nwarning: {summary['warning']}"
        self.tell(
            summary,
            f"{self.out}: mean forces of x {x0:g} .. {x1:g} N and y {y0:g} .. {y1:g} N, "
            f"area {summary['area_n2']:.3g} N2; {summary['held']} of the {summary['nodes']} forces "
            f"on the grid have a gait that produces them to within {summary['tolerance_n']:g} N\n"
            f"references of the paper that this fin cannot reach: {beyond}{warning}",
        )


class TrainArguments(Configured):
    """Train force controllers inside a surrogate by LSTM-PPO (paper Sec. III-C)."""

    surrogate: Annotated[str, plant("SURROGATE", positional=True)]
    """Surrogate folder, or another plant: tank or package.module:plant."""
    out: Out
    """Controller folder to write."""
    controller: PolicyLayout = "single"
    """single: one policy for all references; grid: one policy per cell of a grid."""
    range: TrainingRangeName | None = None
    """Target forces: reach for all forces that the fin can produce (default), or paper for the
    paper's references."""
    clock: Annotated[str, Option("HZ[,S]")] | None = None
    """Clock: actions per second and window [s], e.g. 6,1; auto: from the fin's stroke time
    (default: paper, which is 3,2)."""
    steps: int | None = None
    """Number of training actions per policy (default: 200000, or 33000 per cell of a grid)."""
    seed: int = 0
    """Seed for weights, exploration and references."""
    resume: bool = False
    """Continue from the last checkpoint of an unfinished run."""

    def check(self) -> None:
        """Reject a clock that does not exist."""
        check_clock(self.clock)
        super().check()

    def __call__(self) -> None:
        from softfin.learning.configuration import TRAIN_PRESETS, for_clock
        from softfin.stages.controllers import train

        preset = TRAIN_PRESETS[self.controller]
        if self.clock is not None:
            preset = for_clock(preset, asked_clock(self.clock, self.surrogate))
        config = self.configured(preset, range=self.range)
        with progress() as report:
            result = train(
                self.surrogate,
                self.out,
                config,
                seed=self.seed,
                resume=self.resume,
                overwrite=self.overwrite,
                progress=report,
            )
        self.tell(result, self._format(result["scores"]))

    def _format(self, scores: Sequence[JsonObject]) -> str:
        """Format the scores as a table."""
        from softfin.cli.tables import aligned, format_reference_errors
        from softfin.gaits.reachable import force_decimals

        decimals = force_decimals(max(abs(force) for row in scores for force in row["reference_n"]))
        rows = [["reference [N]", "error x, y [N]", ""]]
        for row in scores:
            x, y = row["reference_n"]
            rows.append(
                [
                    f"({x:5.{decimals}f}, {y:5.{decimals}f})",
                    ", ".join(f"{error:.{decimals + 1}f}" for error in row["error_n"]),
                    format_reference_errors(row, decimals).strip(),
                ]
            )
        head = f"{self.out}: evaluated in {self.surrogate}, without exploration noise"
        return "\n".join([head, *aligned(rows, (0, 1, 2)), *missed_targets(scores)])


def missed_targets(scores: Sequence[JsonObject]) -> list[str]:
    """Return a warning if the errors are larger than half the target forces."""
    error = sum(math.hypot(*row["error_n"]) for row in scores)
    target = sum(math.hypot(*row["tracked_reference_n"]) for row in scores)
    if error <= MAX_ERROR_SHARE * target or target == 0:
        return []
    return [
        f"warning: the errors are {error / target:.0%} of the target forces, so this controller "
        "does not reach them; check training/learning.svg in its folder, and train it longer"
    ]


def check_clock(text: str | None) -> None:
    """Reject a value of ``--clock`` that is not a clock."""
    from softfin.core.action_clock import ActionClock

    if text not in (None, AUTO):
        ActionClock.parse(text)


def asked_clock(text: str | None, plant: str) -> "ActionClock":
    """Return the clock of ``--clock`` for a plant; the paper's without it."""
    from softfin.core.action_clock import PAPER_CLOCK, ActionClock
    from softfin.stages.controllers import propose_clock

    if text is None:
        return PAPER_CLOCK
    clock = propose_clock(plant) if text == AUTO else ActionClock.parse(text)
    # The window may have been rounded.
    sys.stderr.write(f"clock: {clock}\n")
    return clock


class ExportArguments(Common):
    """Export one step of a controller to ONNX, with its state as inputs and outputs. Requires
    softfin[onnx]."""

    controller: ControllerFolder
    onnx: File
    """File to write; its metadata describe the inputs."""

    def __call__(self) -> None:
        from softfin.control.onnx import EPISODE, export_onnx
        from softfin.control.store import load_controller

        exported = export_onnx(load_controller(self.controller), self.onnx, self.overwrite)
        self.tell(
            {"onnx": str(self.onnx), **exported._asdict()},
            f"{self.onnx}: {exported.bytes:,} bytes, ONNX opset {exported.opset}; "
            f"over {EPISODE} actions, onnxruntime's commands differ from softfin's by at most "
            f"{exported.worst:.1g} (rad, rad/s)\n"
            f"in:  {', '.join(exported.inputs)}\nout: {', '.join(exported.outputs)}",
        )
