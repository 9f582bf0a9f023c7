"""``softfin view``: a plant in, a film or a page of the moving fin out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Configured
from softfin.cli.kinds import File, Force, Plant, folder_of


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Show a fin in motion: its shape, the force on its mount, and the traces of both."""

    out: File
    """What to write: a film as .gif or .mp4, a page that plays it as .html, its last frame as .png."""
    plant: Plant = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    seconds: float | None = None
    """Duration in the plant's time [s] (10)."""
    centre: float | None = None
    """Angle about which the gait oscillates [rad] (0); --set gait.amplitude_rad, gait.velocity_rad_s for the rest."""
    excitation: bool = False
    """Random commands, as datasets are recorded under, in place of the gait."""
    controller: Annotated[Path, folder_of("controller")] | None = None
    """Folder of a controller that moves the fin in place of the gait."""
    reference: Force | None = None
    """Reference force of the controller, as --reference=X,Y in newton."""
    next_reference: tuple[Force, ...] = ()
    """The next one, as --next-reference=X,Y; each is asked for an equal part of the time."""
    seed: int | None = None
    """Seed of the plant's noise and the random commands (0)."""

    def run(self) -> None:
        """View."""
        from softfin.evaluation.view.view import ViewConfig
        from softfin.stages.view import view

        centre = None if self.centre is None else {"centre_rad": self.centre}
        config = self.configured(
            ViewConfig(), gait=centre, random=self.excitation or None, next_references=self.next_reference
        )
        summary = self.stage(view, self.plant, self.out, config, controller=self.controller, reference=self.reference)
        x, y = summary["mean_force_n"]
        frames = "" if summary["frames"] is None else f", {summary['frames']} frames"
        warning = "" if summary["warning"] is None else f"\nwarning: {summary['warning']}"
        self.tell(
            summary,
            f"{self.out}: {summary['title']}; {summary['seconds']:g} s{frames}, "
            f"mean force ({x:.2f}, {y:.2f}) N{warning}",
        )
