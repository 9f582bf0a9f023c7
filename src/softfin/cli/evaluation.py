"""Commands that show what a fin does: ``evaluate``, ``baselines``, ``view`` and ``reproduce``."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from softfin.cli.common import (
    AnyPlant,
    Armed,
    Common,
    Configured,
    ControllerFolder,
    File,
    ForcePair,
    Out,
    PlantName,
    ReferenceFile,
    folder_option,
)
from softfin.core.choices import MovingReference, ReproducePreset
from softfin.core.errors import ConfigurationError
from softfin.storage import artifact as artifacts
from softfin.storage.registry import is_live


class EvaluateArguments(Armed, Configured):
    """Evaluate a controller on a fin over reference forces (paper Sec. IV-B, Table II)."""

    controller: ControllerFolder
    """Folder of the controller."""
    out: Out
    """Folder to write evaluation.json and the figures to."""
    plant: AnyPlant = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, package.module:plant; or a real one:
    rig, ros2, or one of these with :FILE."""
    reference: tuple[ForcePair, ...] = ()
    """Reference force as --reference=X,Y in newton, once for each (the paper's six)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Seed of the plant's noise (0)."""
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is
    tracked, with a warning."""
    trim: bool = False
    """Add force feedback, which removes the steady-state error of the measured mean force."""
    randomize: float | None = None
    """With the tank: each repetition in a perturbed tank, whose parameters differ by up to this
    fraction; 0: none."""
    moving: tuple[MovingReference, ...] = ()
    """References that move too, within the controller's range: --moving step, --moving ramp,
    --moving sine."""
    reference_file: ReferenceFile | None = None
    """Another that moves: .csv or .parquet with time_s, force_x_n, force_y_n, each row held until
    the next one."""
    error_map: bool = False
    """Draw the error over the whole range of the controller, 7 x 7 references; --set error_map=N
    for N x N."""
    random: int | None = None
    """Evaluate it on so many random references, too, over all that it was trained for and the fin
    can make."""

    def check(self) -> None:
        """Refuse options that do not go with the plant."""
        super().check()
        if is_live(self.plant) and self.randomize is not None:
            raise ConfigurationError(
                f"--randomize {self.randomize:g} needs the virtual tank as plant, got "
                f"{self.plant!r}; leave it out"
            )
        if self.arm and not is_live(self.plant):
            raise ConfigurationError(
                f"--arm: {self.plant} is not a real fin; leave it out, or give --plant rig"
            )

    def __call__(self) -> None:
        from softfin.cli.driving import KeyboardStop
        from softfin.cli.tables import table_two
        from softfin.evaluation.evaluate import EvaluateConfig
        from softfin.evaluation.range_errors import LATTICE_POINTS
        from softfin.rig.robot_setup import find_robot
        from softfin.stages.evaluation import evaluate
        from softfin.stages.live import evaluate_live
        from softfin.task.signals import read_reference_file

        recorded = (
            None
            if self.reference_file is None
            else read_reference_file(self.reference_file).model_dump()
        )
        config = self.configured(
            EvaluateConfig(),
            references=self.reference,
            recorded=recorded,
            strict=self.strict or None,
        )
        if self.error_map and config.error_map is None:
            config = config.merged({"error_map": LATTICE_POINTS}, "options")
        if self.trim and config.trim is None:
            config = config.merged({"trim": {}}, "options")
        if is_live(self.plant):
            robot = find_robot(self.plant)
            keys = KeyboardStop(self.confirm)
            summary = self.stage(
                evaluate_live,
                self.controller,
                robot,
                self.out,
                config,
                keys.confirm,
                stop=keys.stop,
            )
        else:
            summary = evaluate(
                self.controller,
                self.plant,
                self.out,
                config,
                randomize=self.randomize,
                overwrite=self.overwrite,
            )
        parts: dict[str, Callable[[Any], str]]
        parts = {
            "moving": moving_table,
            "error_map": map_line,
            "random": random_line,
            "warning": "warning: {}".format,
        }
        lines = [
            show(found) for name, show in parts.items() if (found := summary.get(name)) is not None
        ]
        self.tell(summary, "\n".join([table_two({summary["conditions"]["kind"]: summary}), *lines]))


def moving_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for every signal: errors, and the longest settling time of its steps over all
    seeds."""
    from softfin.cli.tables import aligned

    cells = [["references that move", "x error", "y error", "settles in"]]
    for row in rows:
        settling = {None: "-", True: f"{row['longest_settling_s']} s", False: "never"}[
            row["settles"]
        ]
        cells.append(
            [f"  {row['described']}", *(f"{row[axis]['error_n']:.3f}" for axis in "xy"), settling]
        )
    return "\n".join(aligned(cells))


def map_line(errors: Mapping[str, Any]) -> str:
    """Return the error map in one line."""
    (x0, y0) = errors["low_n"]
    (x1, y1) = errors["high_n"]
    counts = {
        "not covered": errors["not_covered"],
        "beyond the fin's reach": errors["not_reachable"],
    }
    gaps = "".join(f", {count} {what}" for what, count in counts.items() if count)
    return (
        f"error map, {errors['points']} x {errors['points']} references over x {x0:g} .. {x1:g}, y "
        f"{y0:g} .. {y1:g} N{gaps}: mean {errors['mean_x_n']:.3f}, {errors['mean_y_n']:.3f}, worst "
        f"{errors['worst_x_n']:.3f}, {errors['worst_y_n']:.3f} N"
    )


def random_line(errors: Mapping[str, Any]) -> str:
    """Return the errors over random references in one line."""
    words = (
        f"{name} " + ", ".join(f"{errors[axis][key]:.3f}" for axis in "xy")
        for name, key in (("mean", "mean_n"), ("95% within", "p95_n"), ("worst", "worst_n"))
    )
    return f"{errors['count']} random references: error x, y {', '.join(words)} N"


class BaselinesArguments(Configured):
    """Evaluate baselines without learning: still fin, best sine, inverse model, random search; or
    RecurrentPPO."""

    out: Out
    """Folder to write baselines.json to."""
    plant: PlantName = "tank"
    """The fin that all are evaluated on: tank, a tank's YAML, the folder of a surrogate, or
    package.module:plant."""
    surrogate: PlantName | None = None
    """Plant in which sines and gaits are searched, as a rule the folder of a surrogate of the fin
    (the fin itself)."""
    seconds: int | None = None
    """Length of each experiment (30)."""
    seeds: int | None = None
    """Repetitions (5)."""
    seed: int | None = None
    """Seed of the plant's noise and of the random gaits (0)."""

    def __call__(self) -> None:
        from softfin.evaluation.baselines.baselines import BaselinesConfig
        from softfin.stages.evaluation import baselines

        config = self.configured(BaselinesConfig())
        result = self.stage(baselines, self.plant, self.out, config, surrogate=self.surrogate)
        self.tell(result, baselines_table(result["baselines"], result["left_out"]))


def baselines_table(summaries: Mapping[str, Any], left_out: Mapping[str, str]) -> str:
    """Return Table II of every baseline, then one line for each, with how often limits of plant or
    model change it."""
    from softfin.cli.tables import aligned, table_two

    limited = ("angle_clipped", "velocity_clipped", "amplitude_limited", "direction_limited")
    rows = [["mean over the references [N]", "x error", "y error", "x std", "y std", ""]]
    for name, summary in summaries.items():
        means = (summary["mean"][axis][score] for score in ("error_n", "std_n") for axis in "xy")
        clipped = sum(
            any(row["commanded"].get(limit) for limit in limited) for row in summary["references"]
        )
        note = f"{clipped} of {len(summary['references'])} clipped by the limits" if clipped else ""
        rows.append([name, *map("{:.3f}".format, means), note])
    left = [f"{name}  left out: {why}" for name, why in left_out.items()]
    return "\n".join([table_two(summaries), "", *aligned(rows, (0, 5)), *left])


class ViewArguments(Configured):
    """Show a fin in motion: its shape, the force on its mount, and the traces of both."""

    out: File
    """File to write: a film as .gif, a page that plays it as .html, its last frame as .png."""
    plant: PlantName = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    seconds: float | None = None
    """Duration in the plant's time [s] (10)."""
    centre: float | None = None
    """Angle about which the gait oscillates [rad] (0); --set gait.amplitude_rad,
    gait.velocity_rad_s for the rest."""
    excitation: bool = False
    """Random commands, as datasets are recorded under, in place of the gait."""
    controller: Annotated[Path, folder_option("controller")] | None = None
    """Folder of a controller that moves the fin in place of the gait."""
    reference: ForcePair | None = None
    """Reference force of the controller, as --reference=X,Y in newton."""
    next_reference: tuple[ForcePair, ...] = ()
    """The next one, as --next-reference=X,Y; each is asked for an equal part of the time."""
    seed: int | None = None
    """Seed of the plant's noise and the random commands (0)."""

    def __call__(self) -> None:
        from softfin.evaluation.view.view import ViewConfig
        from softfin.stages.evaluation import view

        centre = None if self.centre is None else {"centre_rad": self.centre}
        config = self.configured(
            ViewConfig(),
            gait=centre,
            random=self.excitation or None,
            next_references=self.next_reference,
        )
        summary = self.stage(
            view, self.plant, self.out, config, controller=self.controller, reference=self.reference
        )
        x, y = summary["mean_force_n"]
        frames = "" if summary["frames"] is None else f", {summary['frames']} frames"
        force = "true force" if summary["force"] == "true force" else "force"
        warning = "" if summary["warning"] is None else f"\nwarning: {summary['warning']}"
        self.tell(
            summary,
            f"{self.out}: {summary['title']}; {summary['seconds']:g} s{frames}, "
            f"mean {force} ({x:.2f}, {y:.2f}) N{warning}",
        )


class ExploreArguments(Common):
    """Make a page to try controllers in: drag the force that you want, and watch the fin hold it;
    no network."""

    controllers: tuple[ControllerFolder, ...]
    """Folders of the controllers, which the page switches between."""
    out: File
    """File to write, as .html."""
    plant: tuple[PlantName, ...] = ("tank",)
    """The fin: tank, a tank's YAML, or the folder of a streaming surrogate; several are switched
    between, and the mean force that a surrogate predicts is drawn next to that of the tank."""

    def check(self) -> None:
        """Refuse a file of another kind."""
        super().check()
        if self.out.suffix != ".html":
            raise ConfigurationError(f"--out {self.out}: a page is written as .html; name it so")
        artifacts.check_file(self.out, self.overwrite)

    def __call__(self) -> None:
        from softfin.stages.explore import explore

        summary = explore(self.controllers, self.out, self.plant, overwrite=self.overwrite)
        held, moved = (", ".join(summary[name]) for name in ("controllers", "plants"))
        self.tell(
            summary,
            f"{self.out}: {held} in {moved}, {summary['bytes'] / 1e6:.1f} MB; open it in a browser",
        )


class ReproduceArguments(Configured):
    """Collect, fit, find gaits, train, evaluate, report in one run: results.json, report.html, the
    paper's tables, and explore.html to try the controllers in."""

    out: Out
    """Folder of the run."""
    preset: ReproducePreset = "demo"
    """How much: demo takes minutes, paper is the paper's full data and budgets, streaming the same
    with a streaming surrogate, best that surrogate, gaits and policies by gradients through it,
    tiny only shows that all works."""
    plant: PlantName = "tank"
    """The fin: tank, package.module:plant, or the folder of a surrogate, which skips collect and
    fit."""
    seed: int = 0
    """First of the seeds."""
    resume: bool = False
    """Go on with a stopped run."""

    def __call__(self) -> None:
        from softfin.cli.tables import format_table_one, table_two
        from softfin.evaluation.headline import headline
        from softfin.stages.reproduce import reproduce
        from softfin.stages.reproduce_config import PRESETS

        config = self.configured(PRESETS[self.preset])
        results = self.stage(
            reproduce, self.plant, self.out, config, seed=self.seed, resume=self.resume
        )
        parts = (
            []
            if results["surrogate"] is None
            else [format_table_one(results["surrogate"]["scores"])]
        )
        evaluated = {
            f"On {self.plant}": "controllers",
            "The same, with force feedback (--trim)": "trimmed",
            "The same in the surrogate that they were trained in": "in_surrogate",
        }
        for title, key in evaluated.items():
            if summaries := results[key]:
                moving = {
                    name: moving_table(rows)
                    for name, each in summaries.items()
                    if (rows := each.get("moving"))
                }
                parts.append(
                    "\n".join(
                        [title, table_two(summaries), *(f"{k}, {v}" for k, v in moving.items())]
                    )
                )
        took = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in results["wall_s"].items())
        processor_s = sum(stage["processor_s"] or 0.0 for stage in results["stages"])
        parts.append(
            f"{took}: {sum(results['wall_s'].values()):.0f} s, {processor_s:.0f} s of processor "
            f"time; {results['peak_memory_gib']:.1f} GiB at most"
        )
        best = headline(results)
        parts.append(
            f"{'' if best is None else best.sentence}\n{self.out / 'report.html'} shows it"
        )
        pages = [stage["page"] for stage in results["stages"] if "page" in stage]
        parts += [
            f"{self.out / page}: drag the force yourself, and watch the fin hold it"
            for page in pages
        ]
        self.tell(results, "\n\n".join(parts))
