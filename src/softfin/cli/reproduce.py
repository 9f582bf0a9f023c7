"""``softfin reproduce``: the main job in one run."""

from dataclasses import dataclass

from softfin.cli.common import Configured
from softfin.cli.kinds import Out, Plant
from softfin.core.choices import ReproducePreset


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Collect, fit, train, evaluate and report in one run: results.json, report.html, both tables of the paper."""

    out: Out
    """Folder of the run."""
    preset: ReproducePreset = "demo"
    """How much: demo takes minutes, paper is the paper's full data and budgets, streaming the same with a streaming
    surrogate, best that surrogate and controllers trained by gradients through it, tiny only shows that all works."""
    plant: Plant = "tank"
    """The fin: tank, package.module:plant, or the folder of a surrogate, which skips collect and fit."""
    seed: int = 0
    """First of the seeds."""
    resume: bool = False
    """Go on with a stopped run."""

    def run(self) -> None:
        """Reproduce."""
        from softfin.cli.tables import table_one, table_two
        from softfin.stages.reproduce import PRESETS, reproduce

        config = self.configured(PRESETS[self.preset])
        results = self.stage(reproduce, self.plant, self.out, config, seed=self.seed, resume=self.resume)
        parts = [] if results["surrogate"] is None else [table_one(results["surrogate"]["scores"])]
        parts.append(f"On {self.plant}\n{table_two(results['controllers'])}")
        if results["in_surrogate"]:
            parts.append(f"The same in the surrogate that they were trained in\n{table_two(results['in_surrogate'])}")
        took = ", ".join(f"{name} {seconds:.0f} s" for name, seconds in results["wall_s"].items())
        parts.append(f"{took}; {results['peak_memory_gib']:.1f} GiB at most\n{self.out / 'report.html'}")
        self.tell(results, "\n\n".join(parts))
