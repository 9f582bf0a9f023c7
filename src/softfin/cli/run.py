"""``softfin run``: a controller on the real fin, references live; no JAX, and nothing of it is needed."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from softfin.cli.common import Common
from softfin.cli.kinds import Force, ReferenceFile
from softfin.cli.live import Driving
from softfin.core.errors import ConfigurationError

if TYPE_CHECKING:
    from softfin.control.controller import LoadedController
    from softfin.rig.references import RecordedReference


@dataclass(frozen=True, kw_only=True)
class Arguments(Driving, Common):
    """Hold reference forces on the real fin; while it runs, type X,Y and Enter for another one, Enter alone to stop."""

    reference: Force | None = None
    """Reference force as --reference=X,Y in newton, at first."""
    reference_file: ReferenceFile | None = None
    """One that moves, instead: .csv or .parquet with time_s, force_x_n, force_y_n, each row held until the next one."""

    def check(self) -> None:
        """Whether there is one reference."""
        if (self.reference is None) == (self.reference_file is None):
            raise ConfigurationError("give --reference=X,Y or --reference-file, one of them")
        super().check()

    def run(self) -> None:
        """Run."""
        from softfin.cli.driving import drive, parties, say, sentence
        from softfin.control.references import resolve_reference
        from softfin.rig.references import LiveReference
        from softfin.rig.stop import StopRequest

        controller, robot = parties(self)
        if self.reference_file is not None:
            references, seconds = self._recorded(controller, self.reference_file)
            result = drive(self, controller, robot, references, seconds, stop=StopRequest(), line=_deaf)
        else:
            assert self.reference is not None
            live = LiveReference(self.reference, lambda asked: resolve_reference(controller, asked, self.strict), say)
            result = drive(self, controller, robot, live, self.seconds, stop=StopRequest(), line=live.set_from_text)
        self.tell(result, sentence(result))

    def _recorded(self, controller: "LoadedController", file: Path) -> "tuple[RecordedReference, int]":
        # Imported here: the file's reader needs more than a robot's computer may have.
        from softfin.cli.driving import say
        from softfin.control.references import resolve_reference
        from softfin.rig.references import RecordedReference
        from softfin.task.reference_file import read_reference_file

        rows = read_reference_file(file)
        forces = [(float(x), float(y)) for x, y in rows.force_n]
        recorded = RecordedReference(
            rows.time_s, forces, lambda asked: resolve_reference(controller, asked, self.strict), say
        )
        return recorded, self.seconds or rows.seconds


def _deaf(_: str) -> None:
    from softfin.cli.driving import say

    say("references come from the file; Enter alone stops the fin")
