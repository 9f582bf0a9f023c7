"""Configuration of Sphinx; `make docs` builds the site into build/docs."""

import importlib.metadata
import logging
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE)]
# Notebooks call softfin as a reader does.
os.environ["PATH"] = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
os.environ["PYTHONPATH"] = os.pathsep.join(
    [str(HERE), *filter(None, [os.environ.get("PYTHONPATH")])]
)

# A kernel that warns of nothing, as its connection never leaves this computer; and no line for each
# notebook.
os.environ["JUPYTER_PATH"] = str(HERE / "jupyter")
logging.getLogger("traitlets").setLevel(logging.WARNING)

project = "softfin"
author = "softfin contributors"
copyright = "softfin contributors, Apache-2.0"
release = importlib.metadata.version("softfin")

extensions = ["myst_nb", "pages"]
html_theme = "furo"
html_title = "softfin"
html_static_path = ["_static"]
html_css_files = ["site.css"]
# Options begin with two hyphens.
smartquotes = False
html_extra_path = [str(HERE.parent / "build" / "extra")]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]

nb_execution_mode = "force"
# Only ends a cell that hangs [s]: the slowest one takes minutes, and many more on a slow or busy
# computer.
nb_execution_timeout = 3600
nb_execution_raise_on_error = True
nb_execution_in_temp = True
nb_merge_streams = True


def deal_out(app: Any, env: Any, pages: list[str]) -> None:
    """Two processes read the pages; of neighbours, as the tutorials are, each gets every second
    one."""
    pages[:] = pages[::2] + pages[1::2]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("env-before-read-docs", deal_out)


# In a process of its own: one in which JAX has computed must not fork, and Sphinx forks.
subprocess.run([sys.executable, "-m", "docs.generate"], cwd=HERE.parent, check=True)
