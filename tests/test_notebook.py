"""The notebook of the quick start, with little data and training."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests import staged
from tests.documents import ROOT
from tests.patience import HANG_S

SMALL = {
    "LOGS": {"logs": 2, "test_logs": 1, "rows": 2 * staged.ROWS},
    "FIT": staged.STREAMING | {"force_updates": 200},
    "MAP": staged.MAP | {"box": None, "spacing_n": None, "nodes": 4},
}


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path) -> None:
    notebook = json.loads((ROOT / "examples" / "quickstart.ipynb").read_text())
    program = []
    for cell in notebook["cells"]:
        tags = cell["metadata"].get("tags", ())
        if cell["cell_type"] != "code" or "install" in tags:
            continue
        assert not cell["outputs"]
        program += cell["source"], ["\n"]
        if "settings" in tags:
            assert all(
                any(line.startswith(f"{name} =") for line in cell["source"]) for name in SMALL
            )
            program.append([f"{name} = {value!r}\n" for name, value in SMALL.items()])
    script = tmp_path / "notebook.py"
    script.write_text("".join(line for lines in program for line in lines))
    subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "Agg"},
        check=True,
        timeout=HANG_S,
    )
    assert (tmp_path / "evaluation" / "evaluation.json").is_file()
