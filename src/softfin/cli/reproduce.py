"""Commands that run every stage: ``demo``, and ``reproduce`` for the paper."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from softfin.cli.common import Configured, Out, PlantName
from softfin.cli.output import progress
from softfin.core.choices import ReproducePreset

if TYPE_CHECKING:
    from softfin.evaluation.results import EvaluationSummary


class DemoArguments(Configured):
    """Run every stage on the virtual tank in a few minutes: collect, fit, train, evaluate. Writes a
    report and a page for trying the controllers."""

    out: Out = Path("runs/demo")
    """Output folder."""
    quick: bool = False
    """Finish in one minute: shows that everything works, but hardly trains."""
    seed: int = 0
    """Seed for data and training."""
    resume: bool = False
    """Continue a stopped run."""

    def __call__(self) -> None:
        _run_stages(self, "tank", "tiny" if self.quick else "demo")


class ReproduceArguments(Configured):
    """Run every stage of the paper: collect, fit, train, evaluate. Writes its tables and figures, a
    report, and a page for trying the controllers."""

    out: Out
    """Output folder."""
    preset: ReproducePreset = "paper"
    """paper: the paper's data and training (hours); demo: a streaming surrogate, gaits and one
    policy (minutes); tiny: only shows that everything works."""
    plant: PlantName = "tank"
    """The fin: tank, package.module:plant, or a surrogate's folder, which skips collect and fit."""
    seed: int = 0
    """First seed."""
    resume: bool = False
    """Continue a stopped run."""

    def __call__(self) -> None:
        from softfin.stages.tables import format_paper_tables

        _run_stages(self, self.plant, self.preset, format_paper_tables())


def _run_stages(
    command: DemoArguments | ReproduceArguments, plant: str, preset: ReproducePreset, *notes: str
) -> None:
    from softfin.evaluation.headline import headline
    from softfin.stages.reproduce import reproduce
    from softfin.stages.reproduce_config import PRESETS
    from softfin.stages.tables import format_table_one

    config = command.configured(PRESETS[preset])
    with progress() as report:
        results = reproduce(
            plant,
            command.out,
            config,
            seed=command.seed,
            resume=command.resume,
            overwrite=command.overwrite,
            progress=report,
        )
    parts = (
        [] if results["surrogate"] is None else [format_table_one(results["surrogate"]["scores"])]
    )
    evaluated = {
        f"On {plant}": results["controllers"],
        "The same, with force feedback (--trim)": results["trimmed"],
        "The same, in the surrogate used for training": results["in_surrogate"],
    }
    for title, summaries in evaluated.items():
        if summaries:
            parts.append(f"{title}\n{_evaluation_tables(summaries)}")
    parts += notes
    took = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in results["wall_s"].items())
    processor_s = sum(stage["processor_s"] or 0.0 for stage in results["stages"])
    parts.append(
        f"{took}: {sum(results['wall_s'].values()):.0f} s, {processor_s:.0f} s of CPU time; "
        f"peak memory {results['peak_memory_gib']:.1f} GiB"
    )
    best = headline(results)
    parts.append(f"{'' if best is None else best.sentence}\nsee {command.out / 'report.html'}")
    pages = [stage["page"] for stage in results["stages"] if "page" in stage]
    parts += [
        f"{command.out / page}: drag the target force and watch the fin follow it" for page in pages
    ]
    command.tell(results, "\n\n".join(parts))


def _evaluation_tables(summaries: "Mapping[str, EvaluationSummary]") -> str:
    """Return Table II, then the moving references of each controller."""
    from softfin.cli.evaluation import moving_table
    from softfin.evaluation.headline import error_decimals
    from softfin.stages.tables import table_two

    lines = [table_two(summaries)]
    for name, summary in summaries.items():
        if rows := summary.get("moving"):
            lines.append(f"{name}, {moving_table(rows, error_decimals(summary))}")
    return "\n".join(lines)
