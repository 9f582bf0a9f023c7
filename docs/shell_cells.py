"""The shell cells of the tutorials: ``%%sh`` shows what a command prints, and why it failed where it did.

IPython's own shows the lines of progress, too, which are for a terminal.
"""

import subprocess

from IPython.core.magic import register_cell_magic


@register_cell_magic
def sh(line: str, cell: str) -> None:
    """Run the cell in a shell, up to the first command that fails."""
    done = subprocess.run(["sh", "-ec", cell], capture_output=True, text=True)
    print(done.stdout, end="")
    if done.returncode:
        raise RuntimeError(done.stderr[-2000:])
