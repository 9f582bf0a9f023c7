"""A robot's computer has no JAX."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

from tests.control.folders import KINDS, folder_option
from tests.patience import HANG_S

ROOT = Path(__file__).parents[2]

WITHOUT = """
import sys

class Refusing:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in sys.argv[1].split():
            raise ImportError(f"{name} is not on this computer")

sys.meta_path.insert(0, Refusing())

import softfin.stages.driving
import softfin.stages.rig
import softfin.stages.doctor
import softfin.rig.monitor.web
import softfin.rig.rig
import softfin.storage.bag.recovery
from pathlib import Path
from softfin.control.controller import Measured
from softfin.control.feedback import Feedback
from softfin.control.references import resolve_reference
from softfin.control.store import load_controller

for folder in sys.argv[2:]:
    controller = load_controller(Path(folder))
    for each in (controller, Feedback(controller)):
        state = each.init()
        for index in range(9):
            reference, _ = resolve_reference(each, (1.0 + index / 8, 0.5), False)
            state, command = each.act(state, Measured(0.1, (1.0, 0.0)), reference)
        print(controller.kind, command.angle, command.velocity)
"""

WITH = """
import sys
import softfin.control.feedback
import softfin.control.store
assert not {"jax", "jaxlib"} & set(sys.modules), "imported"
"""


def run(script: str, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", script, *words], capture_output=True, text=True, timeout=HANG_S
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_kind_acts_with_what_the_robots_part_installs(tmp_path: Path) -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    names = [re.split(r"[<>=]", line)[0] for line in extras["learn"]]
    lacking = ["jaxlib", "PIL", *(name.replace("-", "_") for name in names)]
    said = run(WITHOUT, " ".join(lacking), *(str(folder_option(kind, tmp_path)) for kind in KINDS))
    assert [line.split()[0] for line in said.splitlines()] == [
        kind for kind in ("single", "grid", "gaits") for _ in range(2)
    ]


def test_where_jax_is_installed_it_is_not_waited_for() -> None:
    run(WITH)
