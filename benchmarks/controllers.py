"""Every way to a controller, side by side: training steps a second, and the time until the mean
error is under 0.3 N.

The time needs a real fin's surrogate: with SOFTFIN_PUBLISHED the folder of the authors' published
networks; otherwise it is left out. Speeds are of surrogates with their layout. RecurrentPPO is in
benchmarks/ppo.py, with the same actions.
"""

import os
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from examples.import_keras import read_keras_surrogate

from benchmarks.measure import entry
from benchmarks.nets import published_layout
from softfin.core.plant import Plant
from softfin.gaits.force_map import MapConfig, find_force_map
from softfin.gaits.reachable import Reachable
from softfin.learning.configuration import SINGLE, TRAIN_PRESETS, TrainConfig
from softfin.learning.train import train_policies
from softfin.stages.reproduce import PRESETS
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import Surrogate
from softfin.task.references import PAPER_RANGE

PAPER_PRESETS = {
    kind: TRAIN_PRESETS[kind].merged(changes, kind)
    for kind, changes in PRESETS["paper"].policies.items()
}
"""How the paper trains each kind of controller."""

GOOD_N = 0.3
WIDE = Reachable(np.array([2, 0], np.float32), np.full(32, 4, np.float32))
"""All of the paper's references, so that nothing is surveyed."""
ENVIRONMENTS = (1, 4, 16, 64, 256, 1024)


def run(plant: Plant, config: TrainConfig) -> dict[str, Any]:
    """Seconds to the first update, actions a second from then on, and seconds until the scored
    error is good."""
    start = time.perf_counter()
    moments = list[tuple[float, float]]()

    def note(done: float, _: str) -> None:
        moments.append((time.perf_counter() - start, done))

    with tempfile.TemporaryDirectory() as folder:
        run_directory = RunDirectory(Path(folder) / "controller", {})
        trained = train_policies(plant, config, WIDE, 0, run_directory, note)
    log = trained.log
    whole = config.num_updates * config.ppo.steps_per_update
    when = {round(done * whole): seconds for seconds, done in moments}
    good = [e["step"] for e in log if max(e.get(f"score_{axis}_n", 9.0) for axis in "xy") < GOOD_N]
    # The first scoring compiles too, so the clock starts behind it.
    first = min(len(moments) - 2, max(1, round(len(moments) / config.num_evaluations)))
    (begin, before) = moments[first]
    (end, after) = moments[-1]
    return {
        "before_first_s": moments[0][0],
        "steps_per_s": (after - before) * whole * len(trained.cells) / (end - begin),
        "good_after_s": when[min(good)] if good else None,
        "trained_in_s": end,
    }


def scaling(plant: Plant) -> dict[str, float]:
    """Actions a second of LSTM-PPO with more and more fins side by side."""
    found = {}
    for count in ENVIRONMENTS:
        settings = (
            f"ppo.num_envs={count}",
            f"ppo.num_minibatches={min(count, 8)}",
            "num_evaluations=1",
            f"steps={4 * count * SINGLE.ppo.num_steps}",
        )
        found[str(count)] = run(plant, SINGLE.changed(settings))["steps_per_s"]
    return found


def published() -> Surrogate | None:
    """The authors' networks, where they are at hand."""
    folder = os.environ.get("SOFTFIN_PUBLISHED")
    if folder is None:
        return None
    nets = Path(folder)
    return read_keras_surrogate(
        nets / "cnn_pos_net.keras", nets / "lstm_force_net.keras", nets / "scalers.json"
    )


def main() -> list[dict[str, Any]]:
    fin = published()
    plant = fin or published_layout()
    rows = []
    for kind, config in PAPER_PRESETS.items():
        got = run(plant, config)
        rows.append(_row(f"ppo {kind}", got, 30, known=fin is not None))
    start = time.perf_counter()
    find_force_map(plant, MapConfig(box=PAPER_RANGE))
    rows.append(
        entry("gaits, 7 x 7: found in", time.perf_counter() - start, "s", 120, at_least=False)
    )
    rows.append(
        {
            "figure": "LSTM-PPO against environments",
            "value": None,
            "unit": "actions/s",
            **scaling(plant),
        }
    )
    return rows


def _row(name: str, got: Mapping[str, Any], bar: float, known: bool) -> dict[str, Any]:
    metadata: dict[str, Any] = {key: value for key, value in got.items() if key != "trained_in_s"}
    if not known:
        metadata.pop("good_after_s")
    return entry(f"{name}: trained in", got["trained_in_s"], "s", bar, at_least=False, **metadata)
