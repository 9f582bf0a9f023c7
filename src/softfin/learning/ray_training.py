"""Training on a Ray cluster (extra `ray`): a task for each seed, or for each cell if there is one
seed.

Agents do not exchange data, so each task is a separate training run in a part of the run's folder.
All machines must see that folder at the same path. Ray starts a task again if its worker dies, and
the task resumes at its last checkpoint. The result of a task depends only on its seed and cells,
not on the worker.
"""

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple

import jax
import numpy as np

from softfin.core.errors import ConfigurationError, RunError, SoftfinError
from softfin.core.plant import Plant
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.gaits.gait import ForceMap
from softfin.installation import how_to_add
from softfin.learning.configuration import TrainConfig, check
from softfin.learning.run import BestPolicies, TrainingResult
from softfin.learning.train import find_map, train
from softfin.storage.run_directory import RunDirectory

STORE_BYTES = 256 * 2**20
"""Memory for the objects of a cluster that is started here [bytes]; plants and policies are small.
By default Ray takes a third of all memory."""

CONNECTION_S = 5.0
"""Longest wait for a cluster's address to accept a connection [s]."""

MAX_RETRIES = 2
"""Number of times that a task is started again after its worker died."""

CLUSTER_PROGRAM = """
import os, sys, ray
started = ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1",
                   object_store_memory=int(sys.argv[1]), log_to_driver=False, logging_level="ERROR")
os.write(sys.stdout.fileno(), (started.address_info["gcs_address"] + "\\n").encode())
sys.stdin.read()
ray.shutdown()
"""
"""Program that runs a cluster on this machine for as long as standard input stays open, and prints
its address.

It runs in a process without JAX: Ray forks, and JAX's threads do not survive that.
"""


class Task(NamedTuple):
    """A part of a training run."""

    name: str
    config: TrainConfig
    """Configuration of the run, with the cells of this task."""
    seeds: tuple[int, ...]


def split_into_tasks(config: TrainConfig, seeds: Sequence[int]) -> list[Task]:
    """Return a task for each seed, or for each cell if there is one seed."""
    if len(seeds) > 1:
        return [Task(f"seed-{seed}", config, (seed,)) for seed in seeds]
    tasks = []
    for index, cell in enumerate(config.cells):
        own_config = config.model_copy(update={"cells": (cell,)})
        tasks.append(Task(f"seed-{seeds[0]}-cell-{index}", own_config, tuple(seeds)))
    return tasks


def train_on_ray(
    plant: Plant,
    config: TrainConfig,
    seeds: Sequence[int],
    run_directory: RunDirectory,
    progress: Progress | None = None,
    force_map: ForceMap | None = None,
    cluster: str | None = None,
) -> TrainingResult:
    """Train as `softfin.learning.train.train` does, on the cluster at HOST:PORT or on one started
    for this run.

    A failed task is reported when all others are done, so that their checkpoints are kept.

    Raises:
        ConfigurationError: as `check`; Ray or the cluster cannot be used.
        RunError: a task failed; the last good checkpoints are kept.
    """
    check(plant, config, seeds, force_map)
    if force_map is None:
        force_map = find_map(plant, config, run_directory, progress)
    tasks = split_into_tasks(config, seeds)
    with _connected(cluster) as ray:
        results = _run_tasks(ray, plant, tasks, run_directory, force_map, progress or silent)
    policies, evaluation = jax.tree.map(
        lambda *leaves: np.concatenate(leaves).reshape(len(seeds), -1, *leaves[0].shape[2:]),
        *results,
    )
    limits = Limits(*map(float, plant.limits))
    return TrainingResult(config, limits, tuple(seeds), policies, evaluation, force_map)


def check_cluster(cluster: str | None) -> None:
    """Raise ConfigurationError if Ray is not installed, or no program accepts connections at
    HOST:PORT.

    Ray itself would wait for minutes.
    """
    _import_ray(is_own_cluster=cluster is None)
    if cluster is None:
        return
    host, _, port = cluster.rpartition(":")
    if not (host and port.isdecimal() and int(port) < 2**16):
        raise _cluster_error(cluster, "not an address HOST:PORT")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECTION_S).close()
    except (OSError, UnicodeError) as error:
        raise _cluster_error(cluster, f"nothing answers there ({error})") from error


def _run_tasks(
    ray: Any,
    plant: Plant,
    tasks: Sequence[Task],
    run_directory: RunDirectory,
    force_map: ForceMap | None,
    progress: Progress,
) -> list[BestPolicies]:
    # A task without a GPU sees none, and would compute on the CPU.
    gpus_per_task = 1 if jax.default_backend() == "gpu" else 0
    if gpus_per_task and not ray.cluster_resources().get("GPU"):
        raise ConfigurationError(
            "cluster: has no GPU, and this machine computes on one, so its tasks would never be "
            "scheduled; give a --cluster with GPUs, or set JAX_PLATFORMS=cpu"
        )
    remote = ray.remote(num_cpus=1, num_gpus=gpus_per_task, max_retries=MAX_RETRIES)(_run_task)
    shared = ray.put((plant, force_map))
    running = {
        remote.remote(shared, task, run_directory.part(task.name)): task.name for task in tasks
    }
    results: dict[str, BestPolicies] = {}
    errors: list[SoftfinError] = []
    while running:
        (ready,), _ = ray.wait(list(running), num_returns=1)
        name = running.pop(ready)
        try:
            outcome = ray.get(ready)
        except ray.exceptions.RayTaskError as error:
            outcome = RunError(f"{name}: its worker failed with {_describe(error)}")
        except ray.exceptions.RayError as error:
            outcome = RunError(
                f"{name}: its worker died {MAX_RETRIES + 1} times ({_describe(error)}); what is "
                "finished is kept: check memory and machines, then --resume"
            )
        if isinstance(outcome, SoftfinError):
            errors.append(outcome)
            progress("failed", 1, str(outcome))
        else:
            results[name] = outcome
            progress("train", len(results) / len(tasks), f"{name} done, {len(running)} to go")
    if errors:
        raise errors[0]
    return [results[task.name] for task in tasks]


def _run_task(
    shared: tuple[Plant, ForceMap | None], task: Task, run_directory: RunDirectory
) -> BestPolicies | SoftfinError:
    """Run on a worker; return softfin's own errors as they are, not within a traceback."""
    plant, force_map = shared
    try:
        trained = train(plant, task.config, task.seeds, run_directory, None, force_map)
    except SoftfinError as error:
        return error
    return trained.policies, trained.evaluation


@contextmanager
def _connected(cluster: str | None) -> Iterator[Any]:
    """Connect Ray to a cluster, or to one started on this machine; an existing connection of the
    caller is kept."""
    ray = _import_ray(is_own_cluster=cluster is None)
    if ray.is_initialized():
        yield ray
        return
    with _started() if cluster is None else nullcontext(cluster) as address:
        try:
            ray.init(address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise _cluster_error(address, f"Ray cannot use it ({_describe(error)})") from error
        try:
            yield ray
        finally:
            ray.shutdown()


@contextmanager
def _started() -> Iterator[str]:
    """Start a cluster on this machine and yield its address; it ends with this process, no matter
    how that ends."""
    command = [sys.executable, "-P", "-c", CLUSTER_PROGRAM, str(STORE_BYTES)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as head:
        assert head.stdout is not None
        address = head.stdout.readline().strip()
        if not address:
            raise RunError(
                "Ray does not start on this machine, for the reason above; --engine local works "
                "without it"
            )
        yield address


def _cluster_error(cluster: str, reason: str) -> ConfigurationError:
    return ConfigurationError(
        f"cluster {cluster}: {reason}; give --cluster HOST:PORT as `ray start --head` prints it, "
        "or none for this machine alone"
    )


def _describe(error: Exception) -> str:
    """Describe an error in one line; for an error on a worker, the last line of its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if hasattr(error, "cause") else lines[0]


def _import_ray(is_own_cluster: bool) -> Any:
    """Import Ray without usage statistics; a cluster started here accepts work only from this
    process and its children.

    Ray reads these settings when it is imported. Without the token it would write one to the user's
    home.
    """
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_ENABLE_UV_RUN_RUNTIME_ENV"):
        os.environ.setdefault(name, "0")
    if is_own_cluster and "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        import ray
    except ImportError:
        raise ConfigurationError(
            f"--engine ray needs ray, which is not installed: {how_to_add('ray')}"
        ) from None
    return ray
