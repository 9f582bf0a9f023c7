"""A robot's computer: the commands that run there need none of what learns."""

import subprocess
import sys

import pytest

ABSENT = ("jax", "jaxlib", "equinox", "optax", "cma", "gymnasium", "h5py", "pyarrow", "scipy", "matplotlib", "PIL",
          "dtaidistance", "tensorboardX", "jinja2")  # fmt: skip

BLOCKED = f"""
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {ABSENT!r}:
            raise ModuleNotFoundError(f"{{name}} is not on this computer")

sys.meta_path.insert(0, Absent())
from softfin.cli import main
main(sys.argv[1:])
"""


@pytest.mark.parametrize("command", ["run", "rig", "ros2", "monitor", "bag", "export"])
def test_a_command_of_the_rig_starts_without_what_learns(command: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", BLOCKED, command, "--help"], capture_output=True, text=True, timeout=120, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert f"softfin {command}" in done.stdout
