"""``softfin run``: a controller on the real fin, references live; no JAX, and nothing of it is needed."""

from dataclasses import dataclass

from softfin.cli.driving import Driving, say
from softfin.cli.kinds import Force, ReferenceFile
from softfin.control.references import resolve_reference
from softfin.core.errors import ConfigurationError
from softfin.rig.loop import LiveReference, recorded_reference


@dataclass(frozen=True, kw_only=True)
class Arguments(Driving):
    """Hold reference forces on the real fin; while it runs, type X,Y and Enter for another one, Enter alone to stop."""

    reference: Force | None = None
    """Reference force as --reference=X,Y in newton, at first."""
    reference_file: ReferenceFile | None = None
    """A moving reference instead: .csv or .parquet with time_s, force_x_n, force_y_n, each row held until the next."""

    def check(self) -> None:
        """Refuse two references, or none."""
        if (self.reference is None) == (self.reference_file is None):
            raise ConfigurationError("give --reference=X,Y or --reference-file, one of them")
        super().check()

    def run(self) -> None:
        """Run."""
        controller, robot = self.parties()

        def resolve(force: tuple[float, float]) -> tuple[tuple[float, float], str | None]:
            return resolve_reference(controller, force, self.strict)

        if self.reference is not None:
            live = LiveReference(self.reference, resolve, say)
            return self.tell_errors(self.drive(controller, robot, live, self.seconds, live.set_from_text))
        assert self.reference_file is not None
        # Imported here: the file's reader needs more than a robot's computer may have.
        from softfin.task.signals import read_reference_file

        rows = read_reference_file(self.reference_file)
        recorded = recorded_reference(rows.time_s, [(float(x), float(y)) for x, y in rows.force_n], resolve, say)

        def line(_: str) -> None:
            say("references come from the file; Enter alone stops the fin")

        return self.tell_errors(self.drive(controller, robot, recorded, self.seconds or rows.seconds, line))
