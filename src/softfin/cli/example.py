"""``example`` writes a trained surrogate, controllers and a recording to start with."""

from pathlib import Path
from typing import Annotated

from softfin.cli.common import Common
from softfin.cli.options import Option
from softfin.core.configuration import Configuration
from softfin.stages.example import write_example
from softfin.storage.artifact import check_vacant


def _check_folder(path: str | Path, command: Configuration) -> None:
    check_vacant(Path(path), getattr(command, "overwrite", False), "folder")


class ExampleArguments(Common):
    """Write an example for the virtual tank: a trained surrogate, controllers and a recording."""

    out: Annotated[Path, Option("DIR", True, check=_check_folder)]
    """Output folder; its README.md lists the commands that produced each part."""

    def __call__(self) -> None:
        result = write_example(self.out, overwrite=self.overwrite)
        errors = []
        for name, row in result["errors"].items():
            x, y = row["error_n"]
            errors.append(f"{name}: {x:.3f}, {y:.3f} N")
        self.tell(
            {"example": str(self.out), **result},
            f"{self.out}: a surrogate of the virtual tank, controllers trained in it, and a "
            "one-minute recording\n"
            f"error of the mean force in the tank, x, y: {'; '.join(errors)}\n"
            f"next: softfin evaluate {self.out}/gaits --plant tank --out evaluation; "
            f"see {self.out}/README.md for more",
        )
