"""What the run-only installation must be able to import."""

import subprocess
import sys

from tests.patience import HANG_S

IMPORT_ALL = """
import importlib, pkgutil, sys
missing = ("canopen", "jax", "rclpy", "softfin.emulation")
sys.modules.update(dict.fromkeys(missing))
import softfin.rig
count = 0
for module in pkgutil.walk_packages(softfin.rig.__path__, "softfin.rig."):
    importlib.import_module(module.name)
    count += 1
print(count)
"""


def test_every_module_of_the_rig_is_imported_without_canopen_jax_and_the_emulation():
    done = subprocess.run(
        [sys.executable, "-c", IMPORT_ALL],
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 50
