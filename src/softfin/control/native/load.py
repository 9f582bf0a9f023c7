"""From a controller's folder to a controller that NumPy runs: single, grid or gaits."""

from pathlib import Path
from typing import Any

import numpy as np

from softfin.control.native.controller import NativeController, Step, TrainingRange, Untrimmed
from softfin.control.native.description import AGAIN, LARGEST, MEMORY, Described
from softfin.control.native.files import DESCRIPTION, Folder, read_folder
from softfin.control.native.gaits import Gaits
from softfin.control.native.grid import Grid, Switching
from softfin.control.native.policy import MEASURED, PHASES, Net, Observed
from softfin.control.native.single import Single
from softfin.core.action_clock import ACTION_RATE_HZ, CYCLE_ACTIONS
from softfin.core.errors import ArtifactError
from softfin.core.quantities import Limits
from softfin.gaits.region import Box, Pair, Region
from softfin.storage.artifact import WEIGHTS

FORMAT = 2

ANGLE_UNIT_RAD = np.pi / 2
"""Angles were observed in this unit in training."""

LEAST_DEVIATION = 0.1
"""What hardly varied in training was not blown up beyond this."""

ROUNDED = 1e-5
"""Gaits may be this much beyond [-1, 1], as what is blended and written in float32 may be."""


def load_native(path: Path) -> NativeController:
    """The controller in a folder; raises ArtifactError in one line where it is none, damaged, or for another rate."""
    path = Path(path)
    folder = read_folder(path)
    said = Described(folder.description, str(path / DESCRIPTION))
    kind = _current_kind(said)
    try:
        limits = Limits.of(said.part("limits").values)
    except ValueError as error:
        raise ArtifactError(f"{said.source}: {error}; {AGAIN}") from None
    step, cells = (_gaits if kind == "gaits" else _policies)(said, folder, limits, str(path / WEIGHTS))
    return NativeController(
        name=path.resolve().name,
        kind=kind,
        limits=limits,
        cells=cells,
        region=None if said.values.get("reachable") is None else _region(said.part("reachable")),
        training_range=None if said.values.get("training_range") is None else _range(said.part("training_range")),
        fin=said.text("fin"),
        description=folder.description,
        weights_sha256=folder.sha256,
        step=step,
        acting=Untrimmed(step),
    )


def _current_kind(said: Described) -> str:
    for name in ("format", "action_rate_hz"):
        if name not in said.values:
            raise ArtifactError(f"{said.source}: says no {name}; {AGAIN}")
    if said.values["format"] != FORMAT:
        raise said.wrong("format", f"{FORMAT} for this softfin: update it")
    if said.values["action_rate_hz"] != ACTION_RATE_HZ:
        raise said.wrong("action_rate_hz", f"{ACTION_RATE_HZ} Hz, the rate at which softfin acts")
    kind = said.values.get("controller")
    if kind not in ("single", "grid", "gaits"):
        raise said.wrong("controller", "single, grid or gaits")
    return str(kind)


def _policies(said: Described, folder: Folder, limits: Limits, weights: str) -> tuple[Step, tuple[Box, ...]]:
    task, policy, cells = said.part("task"), said.part("policy"), _cells(said)
    observed = Observed(task.whole("past_actions", MEMORY, default=3), task.flag("phase", default=False))
    force_scale = task.number("force_scale_n", 1 / LARGEST, default=3.0)
    units, width = (policy.whole(name, int(LARGEST), default=64, least=1) for name in ("units", "width"))
    numbers = MEASURED + observed.actions + observed.phase * PHASES.shape[1]
    stack = () if said.values["controller"] == "single" else (len(cells),)
    if stack == () and len(cells) != 1:
        raise said.wrong("cells", "one cell for a single controller")
    arrays = _shaped(folder.arrays, _shapes(numbers, units, width), stack, weights)
    net = _folded(arrays, units, force_scale)
    rest = np.array([_share(0.0, limits.angle_min, limits.angle_max), -1.0], np.float32)
    if stack == ():
        return Single(net, observed, rest), cells
    low, high = (np.array([getattr(cell, corner) for cell in cells], np.float32) for corner in ("low", "high"))
    return Grid(net, observed, rest, low, high, _switching(said)), cells


def _shapes(numbers: int, units: int, width: int) -> dict[str, tuple[int, ...]]:
    """Of one policy's weights; the observation has `numbers`."""
    return {
        "net.lstm.kernel": (numbers, 4 * units),
        "net.lstm.recurrent": (units, 4 * units),
        "net.lstm.bias": (4 * units,),
        "net.hidden.kernel": (units, width),
        "net.hidden.bias": (width,),
        "net.output.kernel": (width, 2),
        "net.output.bias": (2,),
        "normalisation.mean": (numbers,),
        "normalisation.deviation": (numbers,),
        "normalisation.count": (),
        "log_deviation": (2,),
    }


def _shaped(
    arrays: dict[str, np.ndarray], shapes: dict[str, tuple[int, ...]], stack: tuple[int, ...], source: str
) -> dict[str, np.ndarray]:
    if odd := sorted(set(shapes) ^ set(arrays)):
        raise ArtifactError(f"{source}: weights {', '.join(odd)[:200]} are missing or unknown; copy the folder again")
    for name, shape in shapes.items():
        if arrays[name].shape != stack + shape:
            raise ArtifactError(
                f"{source}: {name} has shape {arrays[name].shape}; its configuration needs {stack + shape}; copy the "
                "folder again"
            )
    return arrays


def _folded(arrays: dict[str, np.ndarray], units: int, force_scale: float) -> Net:
    """With units, normalisation and the gates' halves in the weights, worked out in double precision."""
    kernel, mean, deviation = (
        arrays[name].astype(float) for name in ("net.lstm.kernel", "normalisation.mean", "normalisation.deviation")
    )
    normalised = kernel / np.maximum(deviation, LEAST_DEVIATION)[..., None]
    unit = np.ones(kernel.shape[-2])
    unit[:MEASURED] = 1 / ANGLE_UNIT_RAD, 1 / force_scale, 1 / force_scale
    bias = arrays["net.lstm.bias"] - (mean[..., None, :] @ normalised)[..., 0, :]
    recurrent = arrays["net.lstm.recurrent"].astype(float)
    return Net(
        _gates(np.concatenate([normalised * unit[:, None], recurrent], axis=-2), units),
        _gates(bias, units),
        *(arrays[f"net.{layer}.{part}"] for layer in ("hidden", "output") for part in ("kernel", "bias")),
    )


def _gates(weights: np.ndarray, units: int) -> np.ndarray:
    """From input, forget, cell, output as they are trained to input, forget, output, cell, the first three halved."""
    i, f, g, o = (weights[..., k * units : (k + 1) * units] for k in range(4))
    return np.ascontiguousarray(np.concatenate([i / 2, f / 2, o / 2, g], axis=-1), np.float32)


def _share(value: float, low: float, high: float) -> float:
    return 2 * (value - low) / (high - low) - 1


def _switching(said: Described) -> Switching:
    part = Described({}, said.source) if said.values.get("switching") is None else said.part("switching")
    return Switching(
        part.number("margin_n", 0, default=0.1),
        part.whole("fade_actions", CYCLE_ACTIONS, default=CYCLE_ACTIONS),
        part.number("step_n", 1 / LARGEST, default=0.5),
        part.flag("replay", default=True),
    )


def _cells(said: Described) -> tuple[Box, ...]:
    cells = said.values.get("cells")
    if not isinstance(cells, list) or not cells:
        raise said.wrong("cells", "a list of one cell or more")
    return tuple(_box(Described({"cell": cell}, said.source).part("cell"), "low", "high") for cell in cells)


def _box(said: Described, low: str, high: str) -> Box:
    box = Box(said.pair(low), said.pair(high))
    if box.low[0] > box.high[0] or box.low[1] > box.high[1]:
        raise said.wrong(low, f"not above {high}, {box.high}")
    return box


def _gaits(said: Described, folder: Folder, limits: Limits, weights: str) -> tuple[Step, tuple[Box, ...]]:
    lattice = said.part("lattice")
    box = _box(lattice, "low_n", "high_n")
    nodes = lattice.pair("nodes")
    if not all(count >= 2 and count.is_integer() for count in nodes):
        raise lattice.wrong("nodes", "two or more in x and in y")
    shape = (int(nodes[0]), int(nodes[1]))
    shapes: dict[str, tuple[int, ...]] = {
        "actions": (*shape, CYCLE_ACTIONS, 2), "force_n": (*shape, 2), "smoothness_n": (*shape, 2)
    }  # fmt: skip
    actions = _shaped(folder.arrays, shapes, (), weights)["actions"]
    if np.abs(actions).max() > 1 + ROUNDED:
        raise ArtifactError(f"{weights}: gaits beyond [-1, 1], the limits of the plant; {AGAIN}")
    low, high = (np.array(corner, np.float32) for corner in box)
    return Gaits(low, high, actions), (box,)


def _region(said: Described) -> Region:
    radius = said.numbers("radius_n", 0)
    if len(radius) < 3:
        raise said.wrong("radius_n", "three or more distances")
    return Region.of(said.pair("centre_n"), radius)


def _range(said: Described) -> TrainingRange:
    def between(name: str) -> Pair | None:
        if said.values.get(name) is None:
            return None
        low, high = said.pair(name)
        if low > high:
            raise said.wrong(name, "least and greatest")
        return low, high

    named: Any = {name: between(name) for name in TrainingRange._fields}
    return TrainingRange(**named)
