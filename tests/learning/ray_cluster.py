"""Ray for the tests, in a network of its own with nothing but loopback: Ray listens more widely
than it is told.

`python -m tests.learning.ray_cluster CASE FOLDER` is what runs in there; `within` starts it and
ends all it started.
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
from softfin.core.quantities import Limits
from softfin.gaits.reachable import Cell
from softfin.learning.configuration import TrainConfig
from softfin.learning.policy import PolicyConfig
from softfin.learning.ppo import PPOConfig
from softfin.learning.ray_training import split_into_tasks, train_on_ray
from softfin.learning.run import TrainingResult
from softfin.learning.train import train
from softfin.storage.artifact import WEIGHTS
from softfin.storage.run_directory import LOG, RunDirectory, read_training_log
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
    jax.tree.map(
        np.testing.assert_array_equal,
        (one.policies, one.evaluation),
        (other.policies, other.evaluation),
    )


def within(case: str, folder: Path) -> dict[str, Any]:
    """What a case tells; skips the test where there is no Ray, or no network of one's own to be
    had."""
    needs.module("ray", "the extra ray is not installed")
    if (
        shutil.which("unshare") is None
        or subprocess.run([*ALONE, "true"], capture_output=True).returncode
    ):
        needs.give_up(
            "ray", "Ray is tried in a network namespace of its own, and none can be had here"
        )
    command = [*ALONE, sys.executable, "-m", "tests.learning.ray_cluster", case, str(folder)]
    environment = os.environ | {"HOME": str(folder)}
    run = subprocess.run(
        command,
        cwd=Path(__file__).parents[2],
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    told: dict[str, Any] = json.loads((folder / "told.json").read_text())
    return told


class Deadly(RunDirectory):
    """Kills the process that saves the second checkpoint of one task, once."""

    def save(self, tree: Any, metadata: dict[str, Any]) -> None:
        super().save(tree, metadata)
        deaths = len(list(self.folder.glob("death-*")))
        if self.folder.name == "seed-1" and metadata["updates"] == 2 and not deaths:
            (self.folder / f"death-{deaths}").touch()
            os.kill(os.getpid(), signal.SIGKILL)

    def load(self, like: Any) -> Any:
        """Leaves behind from which update on the attempt goes on."""
        found = super().load(like)
        self.folder.mkdir(parents=True, exist_ok=True)
        with (self.folder / "begun").open("a") as file:
            file.write(f"{0 if found is None else found[1]['updates']}\n")
        return found


class Failing(RunDirectory):
    """Fails in one task at its first checkpoint, in the way that the folder's name says."""

    def save(self, tree: Any, metadata: dict[str, Any]) -> None:
        super().save(tree, metadata)
        if self.folder.name != "seed-0":
            return
        way = self.folder.parents[1].name
        if way == "refuse":
            raise RunError("seed-0: out of water")
        if way == "fail":
            raise IndexError("no such fin")
        os.kill(os.getpid(), signal.SIGKILL)


def task_by_task(folder: Path, seeds: tuple[int, ...]) -> TrainingResult:
    """What a run on Ray should give, in this process."""
    results = []
    for task in split_into_tasks(SMALL, seeds):
        trained = train(AnalyticFin(), task.config, task.seeds, run_directory(folder / task.name))
        results.append((trained.policies, trained.evaluation))
    policies, evaluation = jax.tree.map(
        lambda *leaves: np.concatenate(leaves).reshape(len(seeds), -1, *leaves[0].shape[2:]),
        *results,
    )
    limits = Limits(*map(float, AnalyticFin().limits))
    return TrainingResult(SMALL, limits, seeds, policies, evaluation)


def own(folder: Path) -> dict[str, Any]:
    """A cluster that softfin starts and ends."""
    said: list[Any] = []
    theirs = train_on_ray(
        AnalyticFin(),
        SMALL,
        (0,),
        run_directory(folder, seeds=(0,)),
        lambda *note: said.append(note),
    )
    alike(theirs, task_by_task(folder / "here", (0,)))
    import psutil
    import ray

    left = [process.name() for process in psutil.process_iter() if process.pid != os.getpid()]
    return {
        "said": said,
        "left": left,
        "connected": ray.is_initialized(),
        "home": [path.name for path in folder.glob(".ray*")],
    }


def cells(folder: Path) -> dict[str, Any]:
    """Seeds on a cluster of two nodes, as in this process; the worker of one is killed in the
    middle."""
    said: list[Any] = []
    space = run_directory(folder / "ray", kind=Deadly)
    theirs = train_on_ray(
        AnalyticFin(), SMALL, SEEDS, space, lambda *note: said.append(note), cluster=_two_nodes()
    )
    alike(theirs, task_by_task(folder / "here", SEEDS))
    lost = space.folder / "seed-1"
    return {
        "said": said,
        "deaths": len(list(space.folder.rglob("death-*"))),
        "steps": [entry["step"] for entry in read_training_log(lost / LOG)],
        "begun": [int(line) for line in (lost / "begun").read_text().split()],
    }


def failures(folder: Path) -> dict[str, Any]:
    """What goes wrong for good, while the task beside it is done."""
    cluster = _two_nodes()
    told: dict[str, Any] = {}
    for way in ("refuse", "fail", "die"):
        space = run_directory(folder / way, kind=Failing)
        try:
            train_on_ray(AnalyticFin(), SMALL, SEEDS, space, cluster=cluster)
        except SoftfinError as error:
            told[way] = [type(error).__name__, str(error)]
        finished = read_training_log(space.folder / "seed-1" / LOG)[-1]["step"]
        told[way].append(finished)
    return told


def commands(folder: Path) -> dict[str, Any]:
    """``softfin train`` on Ray of this machine, and on a cluster that was there before it."""
    (folder / "train.yaml").write_text(
        json.dumps(GRADIENT | {"cells": [cell.model_dump() for cell in SMALL.cells]})
    )
    common = (
        "train",
        "tests.plants:AnalyticFin",
        "--controller",
        "grid",
        "--config",
        str(folder / "train.yaml"),
    )
    engines = {
        "own": ("--engine", "ray"),
        "cluster": ("--engine", "ray", "--cluster", _two_nodes()),
    }
    for name, options in engines.items():
        command = [sys.executable, "-m", "softfin.cli", *common, *options]
        subprocess.run([*command, "--out", str(folder / name)], check=True)
    return {name: sha256((folder / name / WEIGHTS).read_bytes()).hexdigest() for name in engines}


def _two_nodes() -> str:
    """Of one processor each; they end with the namespace."""
    ray = [
        sys.executable,
        "-m",
        "ray.scripts.scripts",
        "start",
        "--num-cpus=1",
        "--object-store-memory=100000000",
    ]
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
    case = sys.argv[1]
    folder = Path(sys.argv[2])
    # By its own name, so that workers find what is defined here.
    from tests.learning import ray_cluster

    told = getattr(ray_cluster, case)(folder)
    (folder / "told.json").write_text(json.dumps(told))
