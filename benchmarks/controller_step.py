"""One action of a controller on one core: NumPy alone, as on a robot, beside jax.jit and
onnxruntime of the same step.

`limit_us` is how long as many multiplications take over as many weights, read once from the cache,
in one call without anything around it: no step with these weights can be quicker. Weights are
random; speed does not depend on them.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.measure import entry
from softfin.control.controller import LoadedController, Measured
from softfin.control.onnx import export_onnx
from softfin.control.store import load_controller, save_gaits
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Reachable
from softfin.learning.configuration import GRID, SINGLE, TrainConfig, evaluation_references
from softfin.learning.controllers import save_policies
from softfin.learning.policy import Policy, PolicyConfig
from softfin.learning.rollout import PolicyEvaluation
from softfin.learning.train import TrainedPolicies
from softfin.task.references import PAPER_RANGE, divide

WARM = 300
STEPS = 3000

ANGLE = 0.3
FORCE = (1.0, 0.0)
REFERENCE = (2.0, 0.3)
REACH = Reachable(np.zeros(2, np.float32), np.full(12, 9, np.float32))


@contextmanager
def one_core() -> Iterator[None]:
    """This thread, and those that it starts, on the first core that it may use."""
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def percentiles(step: Callable[[Any], Any], state: Any) -> tuple[float, float]:
    """p50 and p99 of a step that is fed what it gave [us]."""
    times = []
    for index in range(WARM + STEPS):
        start = time.perf_counter()
        state = step(state)
        if index >= WARM:
            times.append(1e6 * (time.perf_counter() - start))
    p50, p99 = np.percentile(times, [50, 99])
    return float(p50), float(p99)


def write_policies(folder: Path, config: TrainConfig, units: int) -> None:
    """A controller with an LSTM of so many units and as wide a layer; a grid of nine cells."""
    size = PolicyConfig(units=units, width=units)
    cells = (PAPER_RANGE,) if config.controller == "single" else divide(PAPER_RANGE, 3, 3)
    keys = jax.random.split(jax.random.key(0), len(cells))
    policies = jax.vmap(lambda key: Policy.create(key, size, config.task.observations))(keys)
    nothing = jnp.zeros((len(cells), config.lattice**2, 2))
    evaluation = PolicyEvaluation(nothing, nothing)
    references = evaluation_references(config, cells, REACH)
    log = [{"step": 1, "score_x_n": 0.0, "score_y_n": 0.0}]
    trained = TrainedPolicies(
        config, config.task, cells, REACH, PAPER_LIMITS, policies, references, evaluation, log
    )
    save_policies(folder, trained, {}, {})


def write_gaits(folder: Path) -> None:
    """A table of 7 x 7 gaits."""
    table = GaitTable.over(PAPER_RANGE, 0.5)
    nothing = np.zeros((*table.actions.shape[:2], 2), np.float32)
    force_map = ForceMap(GaitSearchResult(table, nothing, nothing), REACH)
    save_gaits(folder, force_map, 0.1, PAPER_LIMITS, {})


def native(controller: LoadedController) -> tuple[float, float]:
    """As on a robot."""
    return percentiles(
        lambda state: controller.act(state, Measured(ANGLE, FORCE), REFERENCE)[0], controller.init()
    )


def compiled(folder: Path) -> tuple[float, float]:
    """By jax.jit, measurements and commands being NumPy's, as a loop over devices has them."""
    controller: Any = load_controller(folder)
    act = jax.jit(
        lambda state, angle, force, reference: controller.act(
            state, Measured(angle, force), reference
        )
    )

    def step(state: Any) -> Any:
        now = (np.float32(ANGLE), np.array(FORCE, np.float32), np.array(REFERENCE, np.float32))
        state, command = act(state, *now)
        float(command.angle), float(command.velocity)
        return state

    return percentiles(step, controller.init())


def exported(controller: LoadedController, file: Path) -> tuple[float, float]:
    """By onnxruntime, one thread."""
    import onnxruntime

    export_onnx(controller, file)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    start = {name: np.asarray(value) for name, value in controller.step.init()._asdict().items()}

    def step(state: dict[str, Any]) -> dict[str, Any]:
        now = {"angle": ANGLE, "force": FORCE, "reference": REFERENCE}
        found = session.run(
            None, {name: np.array(value, np.float32) for name, value in now.items()} | state
        )
        return dict(zip(state, found[2:], strict=True))

    return percentiles(step, start)


def limit(weights: int) -> float:
    """As many multiplications and additions over as many numbers, in one call [us]."""
    numbers = np.ones(weights, np.float32)

    def step(state: Any) -> Any:
        numbers.dot(numbers)
        return state

    return percentiles(step, None)[0]


def used(controller: LoadedController) -> int:
    """Weights that one action reads."""
    net: Any = getattr(controller.step, "network", None)
    if net is None:
        net = tuple(part[0] for part in getattr(controller.step, "networks", ()))
    # Gaits blend four actions of two numbers.
    return sum(int(np.size(part)) for part in net) or 4 * 2


def main() -> list[dict[str, Any]]:
    written: dict[str, tuple[Callable[[Path], None], float]] = {
        "single, LSTM 64": (lambda folder: write_policies(folder, SINGLE, 64), 30),
        "single, LSTM 256": (lambda folder: write_policies(folder, SINGLE, 256), 100),
        "grid of 9, LSTM 64": (lambda folder: write_policies(folder, GRID, 64), 60),
        "gaits, 7 x 7": (write_gaits, 20),
    }
    rows = []
    with one_core(), tempfile.TemporaryDirectory() as out:
        for index, (name, (write, bar)) in enumerate(written.items()):
            folder = Path(out) / str(index)
            write(folder)
            controller = load_controller(folder)
            (p50, p99) = native(controller)
            in_jax = compiled(folder)
            in_onnx = exported(controller, folder / "step.onnx")
            rows.append(
                entry(
                    f"action, {name}",
                    p50,
                    "us",
                    bar,
                    at_least=False,
                    p99_us=p99,
                    jax_us=in_jax[0],
                    jax_p99_us=in_jax[1],
                    onnxruntime_us=in_onnx[0],
                    onnxruntime_p99_us=in_onnx[1],
                    limit_us=limit(used(controller)),
                )
            )
    return rows
