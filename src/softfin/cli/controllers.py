"""Commands that produce or export controllers: ``map``, ``train`` and ``export``."""

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.cli.common import (
    Common,
    Configured,
    ControllerFolder,
    File,
    Out,
    folder_option,
    plant,
    progress,
)
from softfin.cli.options import Option
from softfin.core.choices import SEEDS, AlgorithmOption, ControllerKind, EngineName
from softfin.core.errors import ConfigurationError
from softfin.core.json_object import JsonObject
from softfin.storage.artifact import load_description
from softfin.task.notation import read_cells, read_range

if TYPE_CHECKING:
    from softfin.core.action_clock import ActionClock
    from softfin.gaits.reachable import Cell, Cells, Reachable
    from softfin.learning.configuration import TrainConfig


AUTO = "auto"
"""Value of --clock: the clock for the fin's stroke time."""
MAP = "map"
PAPER = "paper"
"""Values of --range: all forces that the fin can produce (the default), and the paper's range."""

MAX_ERROR_SHARE = 0.5
"""Largest error of a useful controller, divided by its target forces."""


class MapArguments(Configured):
    """Find the mean forces that a fin can produce, and gaits that produce them."""

    plant: Annotated[str, plant(positional=True)]
    """Surrogate folder, or another plant: tank or package.module:plant."""
    out: Out
    """Output folder for map.json, the gaits and the figure."""
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
    """Train force controllers inside a surrogate (paper Sec. III-C)."""

    surrogate: Annotated[str, plant("SURROGATE", positional=True)]
    """Surrogate folder, or another plant: tank or package.module:plant."""
    out: Out
    """Controller folder to write."""
    controller: ControllerKind = "single"
    """single: one policy for all references; grid: one policy per cell of a grid; gaits: a table of
    gaits (no network)."""
    algorithm: AlgorithmOption = "auto"
    """gradient: gradients through the plant; ppo: LSTM-PPO as in the paper; ppo-hindsight: LSTM-PPO
    with relabelled references; auto: gradient if the plant is differentiable, else ppo."""
    cells: Annotated[str, Option("CELLS")] | None = None
    """Cells of the grid: a uniform grid over --range such as 3x3, a .yaml file of boxes, or paper
    (default: 2x3)."""
    range: Annotated[str, Option("X0,Y0,X1,Y1")] | None = None
    """Range of target forces [N]: map for all forces that the fin can produce (default), or paper
    for 0.5,-1.5,3.5,1.5."""
    clock: Annotated[str, Option("HZ[,S]")] | None = None
    """Clock: actions per second and window [s], e.g. 6,1; auto: from the fin's stroke time
    (default: paper, which is 3,2)."""
    map: Annotated[Path, folder_option("map")] | None = None
    """Folder of this surrogate's map, written by softfin map (default: compute one)."""
    steps: int | None = None
    """Number of training actions per policy (default: depends on the algorithm; for ppo, the
    paper's 30000, or 10000 per cell)."""
    seed: int = 0
    """Seed for weights, exploration and references."""
    seeds: Annotated[str, Option("SEEDS")] | None = None
    """Train several controllers at once, into OUT/seed-N. Either a count, starting at --seed, or a
    list such as --seeds=0,1,2."""
    engine: EngineName = "local"
    """local: in this process; ray: as tasks on a Ray cluster (requires softfin[ray])."""
    cluster: Annotated[str, Option("HOST:PORT")] | None = None
    """Address of the Ray cluster (default: start one on this machine)."""
    resume: bool = False
    """Continue from the last checkpoint of an unfinished run."""

    def check(self) -> None:
        """Reject options that exclude each other."""
        asked_seeds(self.seed, self.seeds)
        check_clock(self.clock)
        if self.range not in (None, MAP, PAPER):
            read_range(self.range)
        if self.cells is not None:
            read_cells(self.cells)
            if self.controller != "grid":
                raise ConfigurationError(
                    f"--cells {self.cells}: {self.controller} has no cells; use --range, or "
                    "--controller grid"
                )
        if self.controller == "gaits" and self.map is not None and self.clock is not None:
            raise ConfigurationError(
                f"--clock {self.clock}: the gaits of --map have a clock already; omit --clock"
            )
        trained = ("algorithm", "seeds", "steps", "resume", "engine", "cluster")
        useless = [f"--{name}" for name in trained if name in self.model_fields_set]
        if self.controller == "gaits" and useless:
            raise ConfigurationError(
                f"{', '.join(useless)}: gaits are not trained; omit these options"
            )
        super().check()

    def __call__(self) -> None:
        from softfin.gaits.force_map import MapConfig
        from softfin.gaits.gait import FinForces
        from softfin.learning.configuration import (
            TrainConfig,
            choose_preset,
            fit_to_reach,
            for_clock,
            reach_box,
        )
        from softfin.stages.controllers import MakeConfig, find_gaits, train
        from softfin.storage.registry import find_plant
        from softfin.task.references import PAPER_RANGE

        within = asked_range(self.range)
        seeds = asked_seeds(self.seed, self.seeds)
        if self.controller == "gaits":
            usual = MapConfig(clock=asked_clock(self.clock, self.surrogate))
            lattice = self.configured(usual, box=within and within.model_dump())
            # With a map, a changed grid is passed on only so that `find_gaits` rejects it.
            given = None if self.map is not None and lattice == MapConfig() else lattice
            with progress() as report:
                find_gaits(
                    self.surrogate,
                    self.out,
                    given,
                    force_map=self.map,
                    overwrite=self.overwrite,
                    progress=report,
                )
            return self._tell((0,))
        # Each algorithm has its own defaults, so it is chosen before other options apply.
        preset, reason = choose_preset(find_plant(self.surrogate), self.controller, self.algorithm)
        if self.clock is not None:
            preset = for_clock(preset, asked_clock(self.clock, self.surrogate))

        def configure(forces: FinForces) -> TrainConfig:
            cells = asked_cells(
                self.controller, self.cells, within, reach_box(forces), forces.reachable
            )
            return self._configured(fit_to_reach(preset, forces), cells)

        config: TrainConfig | MakeConfig = configure
        if self.range == PAPER or (self.cells == PAPER and self.range is None):
            # The paper's references, whatever the fin can produce.
            cells = asked_cells(self.controller, self.cells, within, PAPER_RANGE)
            config = self._configured(preset, preset.cells if self.cells is None else cells)
        with progress() as report:
            train(
                self.surrogate,
                self.out,
                config,
                force_map=self.map,
                seeds=seeds,
                engine=self.engine,
                cluster=self.cluster,
                reason=reason,
                resume=self.resume,
                overwrite=self.overwrite,
                progress=report,
            )
        return self._tell(seeds)

    def _configured(self, preset: "TrainConfig", cells: "Cells | None") -> "TrainConfig":
        """Return a preset with the given cells and settings."""
        config = self.configured(preset, cells=cells)
        if config.algorithm != preset.algorithm:
            raise ConfigurationError(
                f"algorithm = {config.algorithm}: other defaults depend on the algorithm; use "
                f"--algorithm {config.algorithm}"
            )
        return config

    def _tell(self, seeds: tuple[int, ...]) -> None:
        """Print the scores of each controller."""
        from softfin.cli.tables import aligned, format_reference_errors
        from softfin.gaits.reachable import force_decimals
        from softfin.learning.policy import describe_memory

        gaits = self.controller == "gaits"
        several = len(seeds) > 1
        results = []
        texts = []
        for seed in seeds:
            folder = self.out / f"seed-{seed}" if several else self.out
            description = load_description(folder, "controller")
            own: JsonObject = {"seed": seed} if several else {}
            results.append(own | {"controller": str(folder), "scores": description["scores"]})
            scores = description["scores"]
            rows = [
                ["reference [N]", "error of the mean force [N]" if gaits else "error x, y [N]", ""]
            ]
            forces = [abs(force) for row in scores for force in row["reference_n"]]
            decimals = force_decimals(max(forces))
            for row in scores:
                x, y = row["reference_n"]
                errors = [row["missed_n"]] if gaits else row["error_n"]
                rows.append(
                    [
                        f"({x:5.{decimals}f}, {y:5.{decimals}f})",
                        ", ".join(f"{error:.{decimals + 1}f}" for error in errors),
                        format_reference_errors(row, decimals).strip(),
                    ]
                )
            footprint = [] if gaits else [describe_memory(description["memory"])]
            head = f"{folder}: evaluated in {self.surrogate}, without exploration noise"
            warning = [] if gaits else missed_targets(scores)
            texts.append("\n".join([head, *aligned(rows, (0, 1, 2)), *footprint, *warning]))
        self.tell({"controllers": results} if several else results[0], "\n\n".join(texts))


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


def asked_seeds(first: int, text: str | None) -> tuple[int, ...]:
    """Return the seeds selected by ``--seed`` and ``--seeds``; duplicates are rejected later."""
    if text is None:
        return (first,)
    try:
        numbers = tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ConfigurationError(
            f"--seeds {text}: not a count or a list; use e.g. --seeds 3 or --seeds=0,1,2"
        ) from None
    if len(numbers) == 1:
        numbers = tuple(range(first, first + numbers[0]))
    elif first != 0:
        raise ConfigurationError(
            f"--seed {first}: cannot be combined with the list --seeds={text}; omit one of them"
        )
    if not numbers or not all(0 <= seed < SEEDS for seed in numbers):
        raise ConfigurationError(
            f"--seeds {text}: must be one or more whole numbers from 0 to {SEEDS - 1}"
        )
    return numbers


def asked_range(span: str | None) -> "Cell | None":
    """Return the range of ``--range``; None for all forces that the fin can produce."""
    from softfin.task.references import PAPER_RANGE, parse_range

    if span in (None, MAP):
        return None
    return PAPER_RANGE if span == PAPER else parse_range(span)


def asked_cells(
    controller: str,
    cells: str | None,
    within: "Cell | None",
    reach: "Cell",
    reachable: "Reachable | None" = None,
) -> "Cells | None":
    """Return the cells of ``--cells`` and ``--range``, one cell unless the controller is a grid.

    None if neither is given. A uniform grid fills the range, or else the reach, without cells that
    the fin cannot reach.
    """
    from softfin.gaits.reachable import bounding_box
    from softfin.learning.configuration import GRID_SHAPE, without_unreachable
    from softfin.task.references import lattice, parse_cells

    if cells is None and within is None:
        return None
    if controller != "grid":
        return None if within is None else (within,)
    found = (
        lattice(*GRID_SHAPE, within or reach)
        if cells is None
        else parse_cells(cells, within or reach)
    )
    if within is not None and bounding_box(found) != within:
        raise ConfigurationError(
            f"--range {within}: the cells ({cells}) have fixed positions ({bounding_box(found)}); "
            "omit --range, or use a grid that fills it, such as --cells 3x3"
        )
    is_uniform = cells is None or isinstance(read_cells(cells), tuple)
    if is_uniform and reachable is not None:
        return without_unreachable(found, reachable)
    return found


class ExportArguments(Common):
    """Export one step of a controller or of a surrogate to ONNX, with its state as inputs and
    outputs. Requires softfin[onnx]."""

    controller: ControllerFolder | None = None
    """Controller folder; not with --surrogate."""
    surrogate: Annotated[Path, folder_option("surrogate")] | None = None
    """Surrogate folder to export instead: one step of 10 ms, for other simulators."""
    onnx: File
    """File to write; its metadata describe the inputs."""

    def check(self) -> None:
        """Reject a controller with a surrogate, or neither of them."""
        if (self.controller is None) == (self.surrogate is None):
            raise ConfigurationError("use either CONTROLLER or --surrogate DIR")
        super().check()

    def __call__(self) -> None:
        from softfin.storage.onnx_file import OPSET

        if self.controller is not None:
            from softfin.control.onnx import EPISODE, export_onnx
            from softfin.control.store import load_controller

            exported = export_onnx(load_controller(self.controller), self.onnx, self.overwrite)
            checked = (
                f"over {EPISODE} actions, onnxruntime's commands differ from softfin's by at most "
                f"{{}} (rad, rad/s)"
            )
        elif self.surrogate is not None:
            from softfin.surrogate.onnx import CHECK_S, export_surrogate

            exported = export_surrogate(self.surrogate, self.onnx, self.overwrite)
            checked = (
                f"over {CHECK_S} s of random commands, onnxruntime's readings differ from "
                f"softfin's by at most {{}} (rad, rad/s, N)"
            )
        self.tell(
            {"onnx": str(self.onnx), "opset": OPSET, **exported._asdict()},
            f"{self.onnx}: {exported.bytes:,} bytes, ONNX opset {OPSET}; "
            f"{checked.format(f'{exported.worst:.1g}')}\n"
            f"in:  {', '.join(exported.inputs)}\nout: {', '.join(exported.outputs)}",
        )
