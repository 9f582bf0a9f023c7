"""Twelve cells as tasks on Ray: nodes of one core each, as if of as many machines (extra ray;
docs/scaling.md).

Needs a network of its own, because Ray listens more widely than it is told. Each cell takes eight
updates of the default LSTM-PPO in a surrogate of the published layout. The first run on a cluster
starts its workers and compiles their programs, or loads them; the second finds both there. Where
others load the machine, the ratio of processor times tells what that of wall-clock times would be
without them: the one node's over that of the busier of two. `one program` is all cells side by side
in this process, on every core.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from benchmarks.measure import entry
from benchmarks.nets import published_layout
from softfin.learning.configuration import GRID
from softfin.learning.ray_training import train_on_ray
from softfin.learning.train import train
from softfin.storage.run_directory import RunDirectory
from softfin.task.references import PAPER_RANGE, lattice

UPDATES = 8
ADDRESS = "127.0.0.1:6380"


@contextlib.contextmanager
def nodes(count: int) -> Iterator[Callable[[], list[float]]]:
    """A cluster of nodes, each held to a core of its own; a function that tells the processor time
    of each so far."""
    start = [
        sys.executable,
        "-m",
        "ray.scripts.scripts",
        "start",
        "--block",
        "--num-cpus=1",
        "--disable-usage-stats",
        "--node-ip-address=127.0.0.1",
        "--object-store-memory=100000000",
    ]
    import ray  # Brings psutil, too.
    from psutil import Process

    running: list[Process] = []

    def processor_s() -> list[float]:
        families = ([node, *node.children(recursive=True)] for node in running)
        return [sum(sum(process.cpu_times()[:4]) for process in family) for family in families]

    with contextlib.ExitStack() as stack:
        for index, core in enumerate(sorted(os.sched_getaffinity(0))[:count]):
            join = (
                [f"--address={ADDRESS}"]
                if index
                else ["--head", "--port=6380", "--include-dashboard=false"]
            )
            node = subprocess.Popen(
                ["taskset", "-c", str(core), *start, *join], stdout=subprocess.DEVNULL
            )
            stack.callback(node.wait)
            stack.callback(node.terminate)
            running.append(Process(node.pid))
            time.sleep(5.0)
        ray.init(ADDRESS, log_to_driver=False, logging_level="ERROR")
        stack.callback(ray.shutdown)
        while ray.cluster_resources().get("CPU", 0) < count:
            time.sleep(0.2)
        yield processor_s


def trained(cluster: str | None) -> float:
    """Wall-clock time of all twelve cells, on a cluster or in this process [s]."""
    steps = UPDATES * GRID.ppo.steps_per_update
    config = GRID.model_copy(
        update={"cells": lattice(4, 3, PAPER_RANGE), "steps": steps, "num_evaluations": 1}
    )
    with tempfile.TemporaryDirectory() as folder:
        run_directory = RunDirectory(Path(folder) / "out", {})
        begin = time.perf_counter()
        if cluster is None:
            train(published_layout(), config, (0,), run_directory)
        else:
            train_on_ray(published_layout(), config, (0,), run_directory, cluster=cluster)
        return time.perf_counter() - begin


def main() -> list[dict[str, Any]]:
    details: dict[str, Any] = {"load_before": os.getloadavg()[0]}
    wall: dict[int, float] = {}
    busiest: dict[int, float] = {}
    for count in (1, 2):
        with nodes(count) as processor_s:
            details[f"first_run_on_{count}_s"] = trained(ADDRESS)
            before = processor_s()
            wall[count] = details[f"second_run_on_{count}_s"] = trained(ADDRESS)
            busy = [after - begun for after, begun in zip(processor_s(), before, strict=True)]
            busiest[count] = max(busy)
            details[f"second_run_on_{count}_processor_s"] = [round(part, 1) for part in busy]
    for run in ("first", "second"):
        details[f"{run}_run_one_program_s"] = trained(None)
    details["load_after"] = os.getloadavg()[0]
    return [
        entry(
            "12 cells, one worker / two workers, time", wall[1] / wall[2], "ratio", 1.6, **details
        ),
        entry(
            "the same, processor time of the busier worker", busiest[1] / busiest[2], "ratio", 1.6
        ),
    ]
