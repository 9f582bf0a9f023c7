"""Training on a Ray cluster (extra `ray`): one task per seed, or per cell if there is only one
seed.

Agents do not exchange data, so each task is a separate training run in a subfolder of the run's
folder. All machines must have access to that folder at the same path. Ray restarts a task if its
worker dies, and the task resumes from its last checkpoint. The result of a task depends only on its
seed and cells, not on the worker.
"""

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from softfin.core.errors import ConfigurationError, RunError, SoftfinError
from softfin.core.plant import Plant
from softfin.core.progress import Progress, silent
from softfin.core.quantities import Limits
from softfin.gaits.gait import FinForces
from softfin.installation import how_to_add
from softfin.learning.configuration import TrainConfig
from softfin.learning.run import BestPolicies, TrainingResult
from softfin.learning.train import checked_forces, train
from softfin.storage.run_directory import RunDirectory

STORE_BYTES = 256 * 2**20
"""Size of the object store of a cluster started by softfin [bytes]. Plants and policies are small,
but by default Ray would reserve a third of all memory."""

CONNECTION_S = 5.0
"""Timeout of the connection test to a cluster [s]."""

MAX_RETRIES = 2
"""Maximum number of restarts of a task whose worker dies."""

CLUSTER_PROGRAM = """
import os, sys, ray
started = ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1",
                   object_store_memory=int(sys.argv[1]), log_to_driver=False, logging_level="ERROR")
os.write(sys.stdout.fileno(), (started.address_info["gcs_address"] + "\\n").encode())
sys.stdin.read()
ray.shutdown()
"""
"""Program that starts a cluster on this machine, prints its address, and runs until standard input
is closed.

It must run in a process without JAX, because Ray forks and the threads of JAX do not survive a
fork.
"""


FinOfTask: TypeAlias = tuple[Plant, FinForces | None]
"""A plant, and the forces that it can produce, if known."""


class Task(NamedTuple):
    """Part of a training run."""

    name: str
    config: TrainConfig
    """Configuration of the run, with the cells of this task."""
    seeds: tuple[int, ...]


def split_into_tasks(config: TrainConfig, seeds: Sequence[int]) -> list[Task]:
    """Return one task per seed, or per cell if there is only one seed."""
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
    forces: FinForces | None = None,
    cluster: str | None = None,
) -> TrainingResult:
    """Train like `softfin.learning.train.train`, on the cluster at HOST:PORT or on one started for
    this run.

    If a task fails, the error is raised after all other tasks have finished.

    Raises:
        ConfigurationError: `check` failed, or Ray or the cluster cannot be used.
        RunError: a task failed; the last valid checkpoints are kept.
    """
    forces = checked_forces(plant, config, seeds, run_directory, progress, forces)
    tasks = split_into_tasks(config, seeds)
    with _connected(cluster) as ray:
        results = _run_tasks(ray, (plant, forces), tasks, run_directory, progress or silent)
    # Tasks are in the order of seeds, then cells, so the leaves become (seeds, cells, ...).
    policies, evaluation = jax.tree.map(
        lambda *leaves: np.concatenate(leaves).reshape(len(seeds), -1, *leaves[0].shape[2:]),
        *results,
    )
    limits = Limits(*map(float, plant.limits))
    reachable = None if forces is None else forces.reachable
    return TrainingResult(config, limits, tuple(seeds), policies, evaluation, reachable)


def check_cluster(cluster: str | None) -> None:
    """Raise ConfigurationError if Ray is not installed or HOST:PORT does not accept connections.

    This check takes seconds; Ray would wait for minutes.
    """
    _import_ray(is_own_cluster=cluster is None)
    if cluster is None:
        return
    host, _, port = cluster.rpartition(":")
    if not (host and port.isdecimal() and int(port) < 2**16):
        raise _cluster_error(cluster, "invalid address")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECTION_S).close()
    except (OSError, UnicodeError) as error:
        raise _cluster_error(cluster, f"cannot connect ({error})") from error


def _run_tasks(
    ray: Any,
    fin: FinOfTask,
    tasks: Sequence[Task],
    run_directory: RunDirectory,
    progress: Progress,
) -> list[BestPolicies]:
    # Ray hides GPUs from tasks that do not request one, and they would run on the CPU.
    gpus_per_task = 1 if jax.default_backend() == "gpu" else 0
    if gpus_per_task and not ray.cluster_resources().get("GPU"):
        raise ConfigurationError(
            "cluster: has no GPU, but this machine uses one, so its tasks would never be "
            "scheduled; use a --cluster with GPUs, or set JAX_PLATFORMS=cpu"
        )
    remote = ray.remote(num_cpus=1, num_gpus=gpus_per_task, max_retries=MAX_RETRIES)(_run_task)
    # Copied to the object store once, not once per task.
    shared = ray.put(fin)
    running = {}
    for task in tasks:
        running[remote.remote(shared, task, run_directory.part(task.name))] = task.name
    results: dict[str, BestPolicies] = {}
    errors: list[SoftfinError] = []
    while running:
        (ready,), _ = ray.wait(list(running), num_returns=1)
        name = running.pop(ready)
        outcome = _task_outcome(ray, ready, name)
        if isinstance(outcome, SoftfinError):
            errors.append(outcome)
            progress("failed", 1, str(outcome))
        else:
            results[name] = outcome
            progress("train", len(results) / len(tasks), f"{name} done, {len(running)} remaining")
    if errors:
        raise errors[0]
    return [results[task.name] for task in tasks]


def _task_outcome(ray: Any, reference: Any, name: str) -> BestPolicies | SoftfinError:
    """Return the result of a finished task, or its error."""
    try:
        outcome: BestPolicies | SoftfinError = ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        return RunError(f"{name}: its worker failed with {_describe(error)}")
    except ray.exceptions.RayError as error:
        return RunError(
            f"{name}: its worker died {MAX_RETRIES + 1} times ({_describe(error)}); finished tasks "
            "are kept; check memory and machines, then use --resume"
        )
    return outcome


def _run_task(
    fin: FinOfTask, task: Task, run_directory: RunDirectory
) -> BestPolicies | SoftfinError:
    """Run a task on a worker. softfin's errors are returned, because Ray would wrap raised errors
    in a traceback."""
    plant, forces = fin
    try:
        trained = train(plant, task.config, task.seeds, run_directory, None, forces)
    except SoftfinError as error:
        return error
    return trained.policies, trained.evaluation


@contextmanager
def _connected(cluster: str | None) -> Iterator[Any]:
    """Connect Ray to a cluster, or to one started on this machine; use an existing connection if
    there is one."""
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
    """Start a cluster on this machine and yield its address; it ends with this process."""
    # If this process is killed, its end of the pipe to the cluster's standard input is closed, and
    # the cluster ends.
    command = [sys.executable, "-P", "-c", CLUSTER_PROGRAM, str(STORE_BYTES)]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as head:
        assert head.stdout is not None
        address = head.stdout.readline().strip()
        if not address:
            raise RunError(
                "Ray does not start on this machine; see the error above, or use --engine local, "
                "which does not need Ray"
            )
        yield address


def _cluster_error(cluster: str, reason: str) -> ConfigurationError:
    return ConfigurationError(
        f"cluster {cluster}: {reason}; use --cluster HOST:PORT with the address that `ray start "
        "--head` prints, or omit it to use only this machine"
    )


def _describe(error: Exception) -> str:
    """Describe an error in one line; for an error on a worker, the last line of its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    if not lines:
        return type(error).__name__
    return lines[-1] if hasattr(error, "cause") else lines[0]


def _import_ray(is_own_cluster: bool) -> Any:
    """Import Ray with usage statistics disabled.

    A cluster started by softfin gets a random token, so that it accepts work only from this process
    and its children.
    """
    # Ray reads these settings at import. Without RAY_AUTH_TOKEN, it would write a token to the
    # user's home directory.
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_ENABLE_UV_RUN_RUNTIME_ENV"):
        os.environ.setdefault(name, "0")
    if is_own_cluster and "RAY_AUTH_MODE" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    try:
        import ray
    except ImportError:
        raise ConfigurationError(
            f"--engine ray: Ray is not installed; {how_to_add('ray')}"
        ) from None
    return ray
