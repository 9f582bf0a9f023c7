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

SHORT = ("fit.epochs=1", "single.steps=2000", "grid.steps=2000")


def main() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        words = [
            "reproduce",
            "--preset",
            "paper",
            "--out",
            str(out),
            *(f"--set={change}" for change in SHORT),
        ]
        subprocess.run(
            [sys.executable, "-m", "softfin.cli", *words], check=True, stdout=subprocess.DEVNULL
        )
        results = json.loads((out / "results.json").read_text())
    return [
        entry(
            "peak memory of reproduce --preset paper",
            results["peak_memory_gib"],
            "GiB",
            4,
            at_least=False,
            shortened=", ".join(SHORT),
        )
    ]
