"""Peak memory of ``reproduce --preset paper``: the paper's data and all stages, each cut to a few
steps.

Memory depends on how much data is held and on the size of the batches, not on how long training
goes on.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.measure import entry

RUN = """
import sys
from softfin.stages import reproduce

paper = reproduce.PRESETS["paper"]
policies = {kind: {**changes, "steps": 2000} for kind, changes in paper.policies.items()}
short = paper._replace(fit={"epochs": 1}, policies=policies)
reproduce.PRESETS = {"paper": short}
reproduce.reproduce(out=sys.argv[1])
"""
SHORT = "one epoch of the surrogate, 2,000 actions of each policy"


def main() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        subprocess.run([sys.executable, "-c", RUN, str(out)], check=True, stdout=subprocess.DEVNULL)
        results = json.loads((out / "results.json").read_text())
    return [
        entry(
            "peak memory of reproduce --preset paper",
            results["peak_memory_gib"],
            "GiB",
            4,
            at_least=False,
            shortened=SHORT,
        )
    ]
