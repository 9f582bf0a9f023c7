"""``example`` writes a trained surrogate, controllers and a recording to start with."""

from pathlib import Path
from typing import Annotated

from softfin.cli.common import Common
from softfin.cli.options import Option
from softfin.stages.example import write_example
from softfin.storage.artifact import check_vacant


class ExampleArguments(Common):
    """Write an example of the virtual tank: a trained surrogate, controllers, a map and a
    recording."""

    out: Annotated[
        Path,
        Option("DIR", True, check=lambda path, own: check_vacant(path, own.overwrite, "folder")),
    ]
    """Folder to write; its README.md lists how each part was made."""

    def __call__(self) -> None:
        result = write_example(self.out, overwrite=self.overwrite)
        errors = [
            f"{name}: {{:.3f}}, {{:.3f}} N".format(*each["error_n"])
            for name, each in result["errors"].items()
        ]
        self.tell(
            {"example": str(self.out), **result},
            f"{self.out}: a surrogate of the virtual tank, controllers trained in it, a recording "
            "of one minute\n"
            f"error of the mean force in the tank, x, y: {'; '.join(errors)}\n"
            f"next: softfin evaluate {self.out}/single --plant tank --out evaluation; "
            f"{self.out}/README.md has more",
        )
