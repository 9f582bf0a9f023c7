"""The page's scripts that compute, run by Node on data from its standard input."""

import json
import shutil
import subprocess
from typing import Any

from softfin.explorer.page import SIMULATION, read_script
from tests import needs
from tests.patience import HANG_S


def run(driver: str, **given: Any) -> Any:
    """Value of `output` after the driver, which finds what is given in `input`; skips the test
    without Node."""
    node = shutil.which("node")
    if node is None:
        needs.give_up("node", "node is not on PATH")
    script = f"""
"use strict";
const input = JSON.parse(require("fs").readFileSync(0, "utf8"));
{read_script(*SIMULATION)}
let output;
{driver}
require("fs").writeSync(1, JSON.stringify(output));
"""
    done = subprocess.run(
        [node, "-e", script],
        input=json.dumps(given),
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)
