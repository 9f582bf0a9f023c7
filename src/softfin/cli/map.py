"""``softfin map``: a plant in, the mean forces that its fin can make out."""

from dataclasses import dataclass
from typing import Annotated

from softfin.cli.common import Configured
from softfin.cli.kinds import Out, plant


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Find out which mean forces a fin can make in a plant, and the gaits that make them."""

    plant: Annotated[str, plant(positional=True)]
    """Folder of a surrogate; any other plant serves too (tank, package.module:plant)."""
    out: Out
    """Folder to write map.json, the gaits and the figure to."""

    def run(self) -> None:
        """Map."""
        from softfin.gaits.force_map import MapConfig
        from softfin.stages.train import map_forces

        config = self.configured(MapConfig())
        summary = self.stage(map_forces, self.plant, self.out, config)
        # Adding 0 turns -0.0 into 0.
        (x0, y0), (x1, y1) = (tuple(round(x, 2) + 0.0 for x in corner) for corner in summary["box_n"])
        beyond = ", ".join(f"({x:g}, {y:g})" for x, y in summary["beyond"]) or "none"
        warning = "" if summary["warning"] is None else f"\nwarning: {summary['warning']}"
        self.tell(
            summary,
            f"{self.out}: mean forces of x {x0:.2f} .. {x1:.2f} N and y {y0:.2f} .. {y1:.2f} N, "
            f"{summary['area_n2']:.1f} N2 in all; {summary['held']} of the lattice's {summary['nodes']} forces have a "
            f"gait that makes them to within {config.tolerance_n:g} N\n"
            f"the paper's references that this fin cannot make: {beyond}{warning}",
        )
