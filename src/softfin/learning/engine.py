"""Engines, which work on the parts of a run: one after the other in this process, or all at once by Ray (extra `ray`).

On Ray a part whose worker dies runs again, and nothing else is lost. A part that fails otherwise is reported when all
others are done, so that their results are kept.
"""

import os
import secrets
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from functools import partial
from typing import Any, TypeAlias

import jax

from softfin.core.choices import EngineName
from softfin.core.errors import ConfigurationError, RunError, SoftfinError
from softfin.core.program_cache import use_program_cache
from softfin.core.progress import Progress
from softfin.installation import how_to_add

STORE_BYTES = 256 * 2**20
"""Memory for objects of a cluster started here: plants and policies are small; Ray would take a third of all memory."""

CONNECTION_S = 5.0
"""Longest wait for a cluster's address to accept a connection [s]."""

CLUSTER_PROGRAM = """
import os, sys, ray
started = ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1",
                   object_store_memory=int(sys.argv[1]), log_to_driver=False, logging_level="ERROR")
os.write(sys.stdout.fileno(), (started.address_info["gcs_address"] + "\\n").encode())
sys.stdin.read()
ray.shutdown()
"""
"""Program of a cluster of this machine alone, for as long as standard input stays open; it prints its address.

It runs in a process without JAX: Ray forks, and JAX's threads do not survive that.
"""


Work: TypeAlias = Callable[[Any, Progress | None], Any]
"""Work on one part, which reports its progress where it can; it gives the same result wherever it runs."""


class Engine:
    """Works on one part after the other in this process; other engines override `map`."""

    def map(self, stage: str, work: Work, parts: Mapping[str, Any], progress: Progress | None) -> list[Any]:
        """The result of every part, in their order; an error ends the run. `stage` names the whole in the progress."""

        def report(index: int, name: str, _: str, fraction: float, note: str) -> None:
            if progress is not None:
                progress(stage, (index + fraction) / len(parts), note if len(parts) == 1 else f"{name}: {note}")

        return [work(item, partial(report, i, name)) for i, (name, item) in enumerate(parts.items())]


class RayEngine(Engine):
    """Works on all parts at once, in a cluster at host:port or one started on this machine for the run."""

    attempts = 3
    """Times that a part is begun before it is given up."""

    def __init__(self, cluster: str | None = None) -> None:
        """Raise ConfigurationError where Ray is not installed, or nothing answers at the cluster's address."""
        self.cluster, self._ray = cluster, _installed(own=cluster is None)
        if cluster is not None:
            _check_reachable(cluster)

    def map(self, stage: str, work: Work, parts: Mapping[str, Any], progress: Progress | None) -> list[Any]:
        """The result of every part, in their order; raises what the first failing part raised, or RunError."""
        progress = progress or (lambda *_: None)
        with self._connected() as ray:
            # A task without a graphics card is shown none, and would compute on the processor.
            cards = 1 if jax.default_backend() == "gpu" else 0
            if cards and not ray.cluster_resources().get("GPU"):
                raise ConfigurationError(
                    "cluster: has no graphics card, and this machine computes on one, so its tasks would wait for "
                    "ever; give a --cluster with cards, or set JAX_PLATFORMS=cpu"
                )
            # Ray's own retries would not be reported.
            task = ray.remote(num_cpus=1, num_gpus=cards, max_retries=0)(_worked)
            shared = ray.put(work)
            running = {task.remote(shared, item): (name, 1) for name, item in parts.items()}
            results: dict[str, Any] = {}
            failed: list[SoftfinError] = []
            while running:
                (ready,), _ = ray.wait(list(running), num_returns=1)
                name, attempt = running.pop(ready)
                try:
                    outcome = ray.get(ready)
                except ray.exceptions.RayTaskError as error:
                    outcome = RunError(f"{name}: its worker failed with {_reason(error)}")
                except ray.exceptions.RayError as error:
                    if attempt < self.attempts:
                        progress("lost worker", 1, f"{name} runs again, attempt {attempt + 1} of {self.attempts}")
                        running[task.remote(shared, parts[name])] = (name, attempt + 1)
                        continue
                    outcome = RunError(f"{name}: its worker died {self.attempts} times ({_reason(error)}); what is "
                                       "finished is kept: look after memory and machines, and --resume")  # fmt: skip
                if isinstance(outcome, SoftfinError):
                    failed.append(outcome)
                    progress("failed", 1, str(outcome))
                else:
                    results[name] = outcome
                    progress(stage, len(results) / len(parts), f"{name} done, {len(running)} to go")
            if failed:
                raise failed[0]
            return [results[name] for name in parts]

    @contextmanager
    def _connected(self) -> Iterator[Any]:
        """Ray within a cluster; one that the caller is in already stays as it is."""
        ray = self._ray
        if ray.is_initialized():
            yield ray
            return
        with nullcontext(self.cluster) if self.cluster is not None else _started() as address:
            try:
                ray.init(address, log_to_driver=False, logging_level="ERROR")
            except (ConnectionError, RuntimeError, ValueError) as error:
                raise _unusable(address, f"Ray cannot use it ({_reason(error)})") from error
            try:
                yield ray
            finally:
                ray.shutdown()


def find_engine(name: EngineName, cluster: str | None = None) -> Engine:
    """The engine of that name; raises ConfigurationError where Ray is not installed, or the cluster cannot be used."""
    if name == "ray":
        return RayEngine(cluster)
    if cluster is not None:
        raise ConfigurationError(f"cluster {cluster}: the local engine has none; give --engine ray, or no --cluster")
    return Engine()


def _check_reachable(cluster: str) -> None:
    """Raise ConfigurationError where no program accepts connections at HOST:PORT; Ray itself would wait for minutes."""
    host, _, port = cluster.rpartition(":")
    if not (host and port.isdecimal() and int(port) < 2**16):
        raise _unusable(cluster, "not an address HOST:PORT")
    try:
        socket.create_connection((host.strip("[]"), int(port)), CONNECTION_S).close()
    except (OSError, UnicodeError) as error:
        raise _unusable(cluster, f"nothing answers there ({error})") from error


def _unusable(cluster: str, reason: str) -> ConfigurationError:
    """The error of a cluster that cannot be used."""
    return ConfigurationError(
        f"cluster {cluster}: {reason}; give --cluster HOST:PORT as `ray start --head` tells it, or none for this "
        "machine alone"
    )


@contextmanager
def _started() -> Iterator[str]:
    """The address of a cluster on this machine; it ends with this process, however that ends."""
    command = [sys.executable, "-P", "-c", CLUSTER_PROGRAM, str(STORE_BYTES)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as head:
        assert head.stdout is not None
        address = head.stdout.readline().strip()
        if not address:
            raise RunError("Ray does not start on this machine, for the reason above; --engine local works without it")
        yield address


def _worked(work: Work, item: Any) -> Any:
    """Runs on the worker; errors of ours come back as they are, not within a traceback."""
    # A worker is a process of softfin's own, and this is where it starts.
    use_program_cache()
    try:
        return work(item, None)
    except SoftfinError as error:
        return error


def _reason(error: Exception) -> str:
    """Describe an error in one line; for an error on a worker, the last line of its traceback."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1 if hasattr(error, "cause") else 0] if lines else type(error).__name__


def _installed(own: bool) -> Any:
    """Ray; it sends no statistics, and a cluster of one's `own` takes work from this process and its children alone.

    Ray reads these settings when it is imported. Without the token it would write one to the user's home.
    """
    for name in ("RAY_USAGE_STATS_ENABLED", "RAY_ENABLE_UV_RUN_RUNTIME_ENV"):
        os.environ.setdefault(name, "0")
    if own and "RAY_AUTH_MODE" not in os.environ:
        os.environ |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    try:
        import ray
    except ImportError:
        raise ConfigurationError(f"--engine ray needs ray, which is not installed: {how_to_add('ray')}") from None
    return ray
