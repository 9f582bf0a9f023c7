"""Agents over two devices; in a process of its own, because JAX counts its devices when it
starts."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.learning import run as run_module
from softfin.learning.configuration import TrainConfig
from softfin.learning.run import TrainingRun
from tests.learning.ray_cluster import SMALL
from tests.patience import HANG_S
from tests.plants import AnalyticFin

FORCED = "--xla_force_host_platform_device_count=2"


@pytest.mark.parametrize(
    ("agents", "devices", "used"), [(6, 4, 3), (8, 4, 4), (5, 4, 1), (1, 8, 1), (49, 8, 7)]
)
def test_as_many_devices_share_the_agents_as_get_equal_parts(agents, devices, used, monkeypatch):
    run = TrainingRun(AnalyticFin(), SMALL, (0,), None)
    tree = (jnp.zeros(agents),)
    run.agents = [(0, SMALL.cells[0])] * agents
    chosen: list[Any] = []
    monkeypatch.setattr(jax, "devices", lambda: list(range(devices)))
    monkeypatch.setattr(run_module, "Mesh", lambda found, _: chosen.extend(found))
    monkeypatch.setattr(run_module, "NamedSharding", lambda *_: None)
    assert (run.over_devices(tree) is tree) == (used == 1)
    assert len(chosen) == (used if used > 1 else 0)


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """One process; how well its programs are optimised is none of the claims."""
    file = tmp_path_factory.mktemp("sharding") / "told.json"
    environment = os.environ | {
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {FORCED}",
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    command = [sys.executable, "-m", "tests.learning.test_devices", str(file)]
    run = subprocess.run(
        command,
        cwd=Path(__file__).parents[2],
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    return json.loads(file.read_text())


@pytest.mark.slow
def test_two_devices_learn_what_one_learns(told: Any):
    assert told["devices"] == 2
    assert told["kept"] == [[1, 4], [1, 4]]
    assert told["apart"] < 1e-5
    assert told["moved"] > 0.005


def _trained() -> dict[str, Any]:
    """What each device keeps of the fins' angles after two updates, and how far these are from
    those of one device."""
    every = jax.devices()

    def updated(config: TrainConfig, devices: list[Any]) -> tuple[Any, Any]:
        jax.devices = lambda: devices
        run = TrainingRun(AnalyticFin(), config, (0,), None)
        lanes = fresh = run.over_devices(run.start().agents)
        for _ in range(2):
            lanes, _ = run.update(lanes, 1)
        return fresh.policy, lanes

    fresh, one = updated(SMALL, every[:1])
    both = updated(SMALL, every)[1]
    shards = both.env_state.states.angle.addressable_shards
    return {
        "devices": len({shard.device for shard in shards}),
        "kept": [list(shard.data.shape) for shard in shards],
        "apart": _apart(both.policy, one.policy),
        "moved": _apart(one.policy.net, fresh.net),
    }


def _apart(one: Any, other: Any) -> float:
    """The greatest distance between weights."""
    pairs = zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    return max(float(np.abs(np.asarray(a) - np.asarray(b)).max()) for a, b in pairs)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(json.dumps(_trained()))
