"""The shell cells of the tutorials: ``%%sh`` shows what a command prints, and why it failed where
it did.

IPython's own shows the lines of progress, too, which are for a terminal.
"""

import os
import shutil
import subprocess
from pathlib import Path

from IPython.core.magic import register_cell_magic


def copy_demo(out: str) -> None:
    """Copy the finished run that SOFTFIN_DEMO names to `out`, for a cell that goes on with it
    instead of repeating it.

    Without SOFTFIN_DEMO there is none, and the cell does the whole run.
    """
    if demo := os.environ.get("SOFTFIN_DEMO"):
        shutil.copytree(Path(demo), out)


@register_cell_magic
def sh(line: str, cell: str) -> None:
    """Run the cell in a shell, up to the first command that fails."""
    done = subprocess.run(["sh", "-ec", cell], capture_output=True, text=True)
    print(done.stdout, end="")
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
