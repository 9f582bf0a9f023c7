"""The example that ships with softfin: a trained surrogate and controllers for the virtual tank. No
JAX.

``examples/make_example.py`` generates its folder with softfin's own commands. ``example.json``
lists these commands, the SHA-256 of each file and the controllers' errors in the tank.
"""

import shutil
from pathlib import Path

from softfin.core.json_object import JsonObject
from softfin.storage import artifact as artifacts

EXAMPLE = Path(__file__).parents[1] / "example"
"""The example's folder in the package."""

EXAMPLE_KIND = "example"


def write_example(out: Path, *, overwrite: bool = False) -> JsonObject:
    """Copy the example to a folder, completely or not at all; returns its description,
    ``example.json``."""

    def copy(folder: Path) -> None:
        # Only the contents are copied, because the package's files may be read-only.
        for file in sorted(file for file in EXAMPLE.rglob("*") if file.is_file()):
            place = folder / file.relative_to(EXAMPLE)
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, place)

    artifacts.write_folder(out, copy, overwrite)
    return artifacts.load_description(out, EXAMPLE_KIND)
