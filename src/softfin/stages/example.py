"""The example that ships with softfin: a trained surrogate and controllers for the virtual tank. No
JAX.

``examples/make_example.py`` generates the folder with softfin's own commands. ``example.json``
lists these commands, the SHA-256 of each file, and the errors of the controllers in the tank.
"""

import shutil
from pathlib import Path
from typing import Annotated

from softfin.core.option_types import DIR, PathLike
from softfin.core.result import Result
from softfin.storage import artifact as artifacts
from softfin.storage.paths import typed_path

EXAMPLE = Path(__file__).parents[1] / "example"
"""Folder of the example in the package."""

EXAMPLE_KIND = "example"


def write_example(
    folder: Annotated[PathLike, DIR],
    *,
    overwrite: bool = False,
) -> Result:
    """Write an example for the virtual tank: a trained surrogate, controllers and a recording.

    Args:
        folder: Output folder; its README.md lists the commands that produced each part.
        overwrite: Replace existing output.

    Returns:
        The contents of example.json: commands, files, and errors of the controllers.

    Example:
        >>> softfin.write_example("example")
    """
    out = Path(folder)
    artifacts.check_vacant(out, overwrite, "folder", "example")

    def copy(place: Path) -> None:
        # Only the contents are copied, because the files of the package may be read-only.
        for file in sorted(file for file in EXAMPLE.rglob("*") if file.is_file()):
            target = place / file.relative_to(EXAMPLE)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)

    artifacts.write_folder(out, copy, overwrite)
    description = artifacts.load_description(out, EXAMPLE_KIND)
    errors = []
    for name, row in description["errors"].items():
        x, y = row["error_n"]
        errors.append(f"{name}: {x:.3f}, {y:.3f} N")
    return Result(
        {"example": str(out), **description},
        f"{out}: a surrogate of the virtual tank, controllers trained in it, and a one-minute "
        "recording\n"
        f"error of the mean force in the tank, x, y: {'; '.join(errors)}\n"
        f"next: softfin evaluate {typed_path(out / 'gaits')} --plant tank --out evaluation; see "
        f"{out}/README.md for more",
    )
