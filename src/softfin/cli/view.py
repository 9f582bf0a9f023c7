"""``softfin view``: a plant in, a film or a page of the moving fin out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import Force, Plant, folder_of
from softfin.cli.options import Option
from softfin.storage import paths


@dataclass(frozen=True, kw_only=True)
class Arguments(Configured):
    """Show a fin in motion: its shape, the force on its mount, and the traces of both."""

    out: Annotated[Path, Option("FILE", check=lambda path, command: paths.check_view(path, command.overwrite))]
    """What to write: a film as .gif or .mp4, a page that plays it as .html, its last frame as .png."""
    plant: Plant = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, or package.module:plant."""
    seconds: float | None = None
    """Duration in the plant's time [s] (10)."""
    centre: float | None = None
    """Angle about which the fin beats [rad] (0); --set gait.amplitude_rad and gait.velocity_rad_s change the rest."""
    excitation: bool = False
    """Random commands, as datasets are recorded under, in place of the gait."""
    controller: Annotated[Path, folder_of("controller")] | None = None
    """Folder of a controller that moves the fin in place of the gait."""
    reference: Force | None = None
    """Reference force that the controller is asked for, as --reference=X,Y in newton."""
    next_reference: tuple[Force, ...] = ()
    """The next one, as --next-reference=X,Y; each is asked for an equal part of the time."""
    seed: int | None = None
    """Seed of the plant's noise and the random commands (0)."""

    def run(self) -> None:
        """View."""
        from softfin.evaluation.view.view import ViewConfig
        from softfin.stages import offline as stages

        gait = None if self.centre is None else {"centre_rad": self.centre}
        config = self.configured(
            ViewConfig(), seconds=self.seconds, seed=self.seed, gait=gait, random=self.excitation or None,
            next_references=list(self.next_reference) or None,
        )  # fmt: skip
        with progress() as report:
            metadata = stages.view(
                self.plant, self.out, config,
                controller=self.controller, reference=self.reference, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
        x, y = metadata["mean_force_n"]
        frames = "" if metadata["frames"] is None else f", {metadata['frames']} frames"
        warning = "" if metadata["warning"] is None else f"\nwarning: {metadata['warning']}"
        self.tell(
            metadata,
            f"{self.out}: {metadata['title']}; {metadata['seconds']:g} s{frames}, "
            f"mean force ({x:.2f}, {y:.2f}) N{warning}",
        )
