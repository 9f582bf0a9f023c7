"""Ray for the tests, in a network of its own with nothing but loopback: Ray listens more widely than it is told.

`python -m tests.learning.ray_cluster CASE FOLDER` is what runs in there; `within` starts it and ends all it started.
"""

import fcntl
import json
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

import jax
import numpy as np

from softfin.core.errors import RunError, SoftfinError
from softfin.gaits.reachable import Cell
from softfin.learning.configuration import TrainConfig
from softfin.learning.engine import RayEngine, find_engine
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.learning.run import TrainingResult
from softfin.learning.train import train_jobs
from softfin.storage.artifact import WEIGHTS
from softfin.storage.run_directory import LOG, RunDirectory, read_log
from softfin.task.task import TaskConfig
from tests import needs
from tests.patience import HANG_S
from tests.plants import AnalyticFin
from tests.staged import GRADIENT

SEEDS = (0, 1)

SMALL = TrainConfig(
    steps=4 * 24,
    cells=(Cell.around((1, -1)), Cell.around((2, 0))),
    task=TaskConfig(episode_actions=12, reference_actions=12),
    policy=PolicyConfig(units=8, width=8),
    ppo=PPOConfig(num_envs=4, num_steps=6, num_epochs=2, num_minibatches=2),
    num_evaluations=4,
)

ALONE = ("unshare", "--map-root-user", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
"""A network and processes of its own: whatever was started in there ends with the first."""


def run_directory(
    folder: Path, resume: bool = False, seeds: tuple[int, ...] = SEEDS, kind: type = RunDirectory
) -> RunDirectory:
    made: RunDirectory = kind(folder / "out", {"seeds": list(seeds)}, resume)
    return made


def alike(one: TrainingResult, other: TrainingResult) -> None:
    """To the bit."""
    jax.tree.map(np.testing.assert_array_equal, (one.policies, one.evaluation), (other.policies, other.evaluation))


def within(case: str, folder: Path) -> dict[str, Any]:
    """What a case tells; skips the test where there is no Ray, or no network of one's own to be had."""
    needs.module("ray", "the extra ray is not installed")
    if shutil.which("unshare") is None or subprocess.run([*ALONE, "true"], capture_output=True).returncode:
        needs.give_up("ray", "Ray is tried in a network namespace of its own, and none can be had here")
    command = [*ALONE, sys.executable, "-m", "tests.learning.ray_cluster", case, str(folder)]
    environment = os.environ | {"HOME": str(folder)}
    run = subprocess.run(
        command, cwd=Path(__file__).parents[2], env=environment, capture_output=True, text=True, timeout=HANG_S
    )
    assert run.returncode == 0, run.stderr[-4000:]
    told: dict[str, Any] = json.loads((folder / "told.json").read_text())
    return told


class Deadly(RunDirectory):
    """Kills the process that saves the second checkpoint of one job, once."""

    def save(self, tree: Any, metadata: dict[str, Any]) -> None:
        super().save(tree, metadata)
        deaths = len(list(self.folder.glob("death-*")))
        if self.folder.name == "seed-1-cell-0" and metadata["updates"] == 2 and not deaths:
            (self.folder / f"death-{deaths}").touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def load(self, like: Any) -> Any:
        """Leaves behind from which update on the attempt goes on."""
        found = super().load(like)
        with (self.folder / "begun").open("a") as file:
            file.write(f"{0 if found is None else found[1]['updates']}\n")
        return found


def own(folder: Path) -> dict[str, Any]:
    """A cluster that the engine starts and ends."""
    said: list[Any] = []
    squares = RayEngine().map("square", _squared, {str(i): i for i in range(4)}, lambda *note: said.append(note))
    import psutil
    import ray

    left = [process.name() for process in psutil.process_iter() if process.pid != os.getpid()]
    return {
        "squares": squares,
        "said": said,
        "left": left,
        "connected": ray.is_initialized(),
        "pid": os.getpid(),
        "home": [path.name for path in folder.glob(".ray*")],
    }


def cells(folder: Path) -> dict[str, Any]:
    """Cells on a cluster of two nodes, as on the local engine; the worker of one is killed in the middle."""
    said: list[Any] = []
    ours = train_jobs(AnalyticFin(), SMALL, SEEDS, run_directory(folder / "local"), split="cell")
    space = run_directory(folder / "ray", kind=Deadly)
    theirs = train_jobs(AnalyticFin(), SMALL, SEEDS, space, lambda *note: said.append(note),
                        engine=find_engine("ray", _two_nodes()), split="cell")  # fmt: skip
    alike(theirs, ours)
    lost = space.folder / "seed-1-cell-0"
    return {
        "said": said,
        "deaths": len(list(space.folder.rglob("death-*"))),
        "steps": [entry["step"] for entry in read_log(lost / LOG)],
        "begun": [int(line) for line in (lost / "begun").read_text().split()],
    }


def failures(folder: Path) -> dict[str, Any]:
    """What goes wrong for good, while the part beside it is done."""
    engine = RayEngine(_two_nodes())
    engine.attempts = 2
    told: dict[str, Any] = {work.__name__: _failure(engine, work, folder) for work in (_refuse, _fail, _die)}
    told["finished"] = sorted(path.name for path in folder.glob("*-other"))
    return told


def commands(folder: Path) -> dict[str, Any]:
    """``softfin train`` in this process, on Ray of this machine, and on a cluster that was there before it."""
    (folder / "train.yaml").write_text(json.dumps(GRADIENT | {"cells": [cell.model_dump() for cell in SMALL.cells]}))
    common = ("train", "tests.plants:AnalyticFin", "--controller", "grid", "--config", str(folder / "train.yaml"))
    engines = {
        "local": ("--split", "cell"),
        "own": ("--engine", "ray"),
        "cluster": ("--engine", "ray", "--cluster", _two_nodes()),
    }
    for name, options in engines.items():
        command = [sys.executable, "-m", "softfin.cli", *common, *options]
        subprocess.run([*command, "--out", str(folder / name)], check=True)
    return {name: sha256((folder / name / WEIGHTS).read_bytes()).hexdigest() for name in engines}


def _failure(engine: RayEngine, work: Any, folder: Path) -> list[Any]:
    said: list[Any] = []
    try:
        engine.map("try", work, {"part": (folder, 0), "other": (folder, 1)}, lambda *note: said.append(note))
    except SoftfinError as error:
        return [type(error).__name__, str(error), said]
    return []


def _squared(item: int, _: Any) -> tuple[int, int]:
    return os.getpid(), item**2


def _refuse(item: tuple[Path, int], _: Any) -> None:
    if item[1] == 0:
        raise RunError("part: out of water")
    (item[0] / "refused-other").touch()


def _fail(item: tuple[Path, int], _: Any) -> None:
    if item[1] == 0:
        raise IndexError("no such fin")
    (item[0] / "failed-other").touch()


def _die(item: tuple[Path, int], _: Any) -> None:
    if item[1] == 0:
        os.kill(os.getpid(), signal.SIGKILL)
    (item[0] / "dead-other").touch()


def _two_nodes() -> str:
    """Of one processor each; they end with the namespace."""
    ray = [sys.executable, "-m", "ray.scripts.scripts", "start", "--num-cpus=1", "--object-store-memory=100000000"]
    head = [
        "--head",
        "--port=6399",
        "--node-ip-address=127.0.0.1",
        "--include-dashboard=false",
        "--disable-usage-stats",
    ]
    for options in (head, ["--address=127.0.0.1:6399", "--node-ip-address=127.0.0.1"]):
        subprocess.run([*ray, *options], check=True, timeout=HANG_S)
    return "127.0.0.1:6399"


def _loopback() -> None:
    """A new network's loopback is down; 0x8914 is SIOCSIFFLAGS, 0x41 up and running."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", 0x41))


if __name__ == "__main__":
    _loopback()
    case, folder = sys.argv[1], Path(sys.argv[2])
    # By its own name, so that workers find what is defined here.
    from tests.learning import ray_cluster

    told = getattr(ray_cluster, case)(folder)
    (folder / "told.json").write_text(json.dumps(told))
