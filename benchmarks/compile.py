"""What users wait for before anything runs: programs, seconds of tracing and of XLA, and their
share of each stage.

Each stage is a command in a process of its own with a cache of its own, run twice: cold, and again
(warm). Other work on the machine lengthens all seconds. With SOFTFIN_PUBLISHED the published
surrogate is the authors' networks; otherwise networks of the same layout with random weights
replace them, which make the same programs.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.compilation import LOWER, TRACE, XLA, Compilation
from benchmarks.controllers import published
from benchmarks.measure import entry
from benchmarks.nets import published_layout
from softfin.core.program_cache import use_program_cache
from softfin.storage import artifact as artifacts
from softfin.surrogate.store import save_surrogate

AGAIN_S = 3
"""Bar for the second run of the same."""

LISTED = 12
"""Functions whose programs take longest, in each row."""

TRAIN = ("--steps=960", "--num-evaluations=1")
"""Two updates, with the programs of many."""


class Stage(NamedTuple):
    """One command of a user's."""

    name: str
    words: tuple[str, ...]
    bar_s: float


def stages(surrogate: Path) -> list[Stage]:
    """In the order in which they need one another's results."""
    demo = Path("demo")
    single = Path("single")
    evaluations = {
        "the tank": (demo / "single", "tank"),
        "the published surrogate": (single, str(surrogate)),
        "a streaming surrogate": (demo / "single", str(demo / "surrogate")),
    }
    return [
        Stage("demo", ("reproduce", "--preset", "demo", "--plant", "tank", "--out", str(demo)), 35),
        Stage(
            "train single, published surrogate",
            (
                "train",
                str(surrogate),
                "--controller",
                "single",
                "--range",
                "paper",
                "--out",
                str(single),
                *TRAIN,
            ),
            25,
        ),
        *(
            Stage(
                f"evaluate in {plant}",
                ("evaluate", str(controller), "--plant", where, "--out", "evaluation"),
                8,
            )
            for plant, (controller, where) in evaluations.items()
        ),
    ]


def write_published(out: Path) -> None:
    """The folder of the published surrogate, or of its stand-in."""
    surrogate = published() or published_layout()
    save_surrogate(out, surrogate, None, artifacts.provenance())


def child(words: Sequence[str]) -> None:
    """Run one command in this process; its figures go to ``figures.json``."""
    from softfin.cli import main as softfin

    use_program_cache()
    compilation = Compilation()
    start = time.perf_counter()
    softfin(words)
    wall_s = time.perf_counter() - start
    names = {name for _, name in compilation.seconds_of}
    seconds = {
        name: [compilation.seconds_of[event, name] for event in (TRACE, LOWER, XLA)]
        for name in names
    }
    figures = {
        "programs": compilation.programs,
        "cache_hits": compilation.cache_hits,
        "trace_s": compilation.seconds(TRACE),
        "lower_s": compilation.seconds(LOWER),
        "xla_s": compilation.seconds(XLA),
        "wall_s": wall_s,
        "functions": {
            name: [compilation.programs_of[name], *(round(value, 3) for value in seconds[name])]
            for name in sorted(names, key=lambda name: -sum(seconds[name]))
        },
    }
    Path("figures.json").write_text(json.dumps(figures))


def measure(words: Sequence[str], folder: Path, cache: Path) -> dict[str, Any]:
    """The figures of a command that runs in `folder` in a fresh process."""
    # The child runs elsewhere, with the same packages.
    paths = os.pathsep.join(str(Path(part).absolute()) for part in sys.path)
    environment = os.environ | {"SOFTFIN_CACHE": str(cache), "PYTHONPATH": paths}
    environment.pop("JAX_COMPILATION_CACHE_DIR", None)
    done = subprocess.run(
        [sys.executable, "-m", "benchmarks.compile", *words],
        cwd=folder,
        env=environment,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"softfin {' '.join(words)}: {done.stderr[-2000:]}")
    figures: dict[str, Any] = json.loads((folder / "figures.json").read_text())
    return figures


def main() -> list[dict[str, Any]]:
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_published(folder / "published")
        for number, stage in enumerate(stages(Path("published"))):
            cache = folder / f"cache-{number}"
            for run, bar_s in (("cold", stage.bar_s), ("again", AGAIN_S)):
                sys.stderr.write(f"  {stage.name}, {run}\n")
                figures = measure([*stage.words, "--overwrite"], folder, cache)
                rows.append(_row(f"{stage.name}: compile and trace, {run}", figures, bar_s))
    return rows


def _row(figure: str, figures: dict[str, Any], bar_s: float) -> dict[str, Any]:
    seconds = figures["trace_s"] + figures["lower_s"] + figures["xla_s"]
    functions = dict(list(figures.pop("functions").items())[:LISTED])
    details = figures | {"share": seconds / figures["wall_s"], "functions": functions}
    return entry(figure, seconds, "s", bar_s, at_least=False, **details)


if __name__ == "__main__":
    child(sys.argv[1:])
