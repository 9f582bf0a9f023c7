"""Runs many trainings at once on a Ray cluster (extra `ray`), with one task per training."""

from collections.abc import Mapping, Sequence
from typing import Any

from softfin.core.errors import ConfigurationError, RunError, SoftfinError
from softfin.core.json_object import JsonObject
from softfin.installation import how_to_add
from softfin.stages.controllers import train

MAX_RETRIES = 2
"""Maximum number of restarts of a training after its worker dies."""


def train_on_ray(
    runs: Sequence[Mapping[str, Any]], cluster: str, num_gpus: float = 0.0
) -> list[JsonObject]:
    """Call `train` once with each mapping of arguments, on a Ray cluster. All machines must have
    the plants and the output folders at the same paths.

    Args:
        runs: Arguments of each call of `train`.
        cluster: Ray cluster, HOST:PORT.
        num_gpus: Number of GPUs of each training, which also uses one processor core.

    Returns:
        The results of `train` in the same order.

    Raises:
        ConfigurationError: If Ray is not installed, or the cluster cannot be used.
        RunError: If a training failed; raised after all other trainings have finished.

    Example:
        >>> softfin.train_on_ray([{"surrogate": "surrogate", "out": "single"}], "head:6379")
    """
    ray = _connect(cluster)
    try:
        options = {"num_cpus": 1, "num_gpus": num_gpus, "max_retries": MAX_RETRIES}
        remote = ray.remote(**options)(_train)
        tasks = [remote.remote(dict(run)) for run in runs]
        outcomes = [_wait(ray, task) for task in tasks]
    finally:
        ray.shutdown()
    results = []
    for run, outcome in zip(runs, outcomes, strict=True):
        if isinstance(outcome, Exception):
            raise RunError(f"training of {run['out']}: {outcome}") from outcome
        results.append(outcome)
    return results


def _connect(cluster: str) -> Any:
    """Connect Ray to a cluster; returns the module."""
    try:
        import ray
    except ImportError:
        raise ConfigurationError(f"Ray is not installed; {how_to_add('ray')}") from None
    try:
        ray.init(cluster, log_to_driver=False)
    except (ConnectionError, RuntimeError, ValueError) as error:
        raise ConfigurationError(
            f"cluster {cluster}: cannot connect ({error}); use the HOST:PORT that `ray start "
            "--head` prints"
        ) from error
    return ray


def _train(arguments: dict[str, Any]) -> JsonObject | SoftfinError:
    """Train on a worker, from the last checkpoint if a previous worker died. softfin's errors are
    returned instead of raised, because Ray would add a traceback."""
    try:
        return train(arguments.pop("surrogate"), **arguments | {"resume": True})
    except SoftfinError as error:
        return error


def _wait(ray: Any, task: Any) -> JsonObject | Exception:
    """Return the result of a task or its error."""
    try:
        outcome: JsonObject | Exception = ray.get(task)
    except ray.exceptions.RayError as error:
        # The text ends with the error on the worker, after the traceback.
        return RunError(str(error).strip().splitlines()[-1])
    return outcome
