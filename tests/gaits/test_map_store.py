"""Maps and gaits on disk."""

import json
import shutil
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors.numpy

from softfin.control.gait import GaitStep
from softfin.control.store import load_controller, save_gaits
from softfin.core.errors import ArtifactError
from softfin.core.plant_identity import identity
from softfin.core.quantities import PAPER_LIMITS
from softfin.gaits.force_map import MapConfig, load_force_map, load_map, save_map
from softfin.gaits.gait import ForceMap, GaitSearchResult, GaitTable
from softfin.gaits.reachable import Reachable
from tests.plants import AnalyticFin, StrokeFin

NUMBERS = np.random.default_rng(0)
TABLE = GaitTable(
    jnp.array([0.5, -1.0]),
    jnp.array([2.5, 2.0]),
    jnp.asarray(NUMBERS.uniform(-1, 1, (3, 4, 6, 2)), jnp.float32),
)
MADE = (TABLE.references() + 0.01).astype(np.float32)
KNOWN = ForceMap(
    GaitSearchResult(TABLE, MADE, NUMBERS.uniform(0, 1, (3, 4, 2)).astype(np.float32)),
    Reachable(np.array([1.5, 0.5], np.float32), np.linspace(1, 2, 12).astype(np.float32)),
)


@cache
def saved() -> Path:
    folder = Path(tempfile.mkdtemp()) / "map"
    save_map(folder, KNOWN, MapConfig(), PAPER_LIMITS, {"plant": "mine"})
    return folder


def save(folder: Path) -> Path:
    return Path(shutil.copytree(saved(), folder / "map"))


def save_controller(folder: Path) -> Path:
    save_gaits(folder / "gaits", KNOWN, MapConfig(), PAPER_LIMITS, {"plant": "mine"})
    return folder / "gaits"


def test_a_map_comes_back_from_its_folder(tmp_path: Path) -> None:
    again, limits, *_ = load_map(save(tmp_path))
    jax.tree.map(np.testing.assert_array_equal, again.gaits, KNOWN.gaits)
    np.testing.assert_allclose(again.reachable.corners(), KNOWN.reachable.corners(), atol=1e-4)
    assert limits == PAPER_LIMITS


def test_gaits_come_back_as_a_controller_with_the_same_table(tmp_path: Path) -> None:
    again = load_controller(save_controller(tmp_path))
    assert isinstance(again.step, GaitStep)
    jax.tree.map(np.testing.assert_array_equal, again.step.table, KNOWN.gaits.table)
    assert again.reachable is not None
    np.testing.assert_allclose(again.reachable.corners(), KNOWN.reachable.corners(), atol=1e-4)
    assert again.limits == PAPER_LIMITS


def test_the_controllers_folder_says_what_each_gait_makes(tmp_path: Path) -> None:
    description = json.loads((save_controller(tmp_path) / "controller.json").read_text())
    assert description["controller"] == "gaits"
    assert len(description["scores"]) == 12
    assert description["scores"][5]["reference_n"] == pytest.approx([1.5, 0.0])
    assert description["scores"][5]["missed_n"] == pytest.approx(0.01 * 2**0.5, abs=1e-4)
    assert description["provenance"] == {"plant": "mine"}


def rewrite(folder: Path, **changes: Any) -> None:
    file = next(folder.glob("*.json"))
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def weights(folder: Path, **changes: Any) -> None:
    file = folder / "weights.safetensors"
    arrays = safetensors.numpy.load_file(file)
    safetensors.numpy.save_file(
        {n: a for n, a in {**arrays, **changes}.items() if a is not None}, file
    )


def lattice(**changes: Any) -> dict[str, Any]:
    return {"low_n": [0.5, -1.0], "high_n": [2.5, 2.0], "nodes": [3, 4], **changes}


HARMS: list[tuple[Callable[[Path], None], str]] = [
    (lambda f: (f / "weights.safetensors").unlink(), "weights.safetensors: missing"),
    (lambda f: (f / "weights.safetensors").write_bytes(b"12"), "truncated or damaged"),
    (
        lambda f: rewrite(f, format=99),
        "format is 99, written by a newer softfin; this softfin reads .; update softfin",
    ),
    (lambda f: rewrite(f, reachable=None), "reachable = None: must be an object"),
    (
        lambda f: rewrite(f, reachable={"centre_n": [0, 0], "radius_n": [1, -1, 1]}),
        "no radius negative",
    ),
    (lambda f: rewrite(f, limits={}), "angle_min_rad is missing"),
    (
        lambda f: rewrite(f, limits=PAPER_LIMITS._replace(velocity_max=9000.0).to_dict()),
        "velocity_max_rad_s is 9000",
    ),
    (lambda f: rewrite(f, lattice=lattice(nodes=[4, 3])), r"do not fit a lattice of \(4, 3\)"),
    (
        lambda f: rewrite(f, lattice=lattice(nodes=[12])),
        r"lattice of \(12,\) nodes; a lattice must have at least two",
    ),
    (
        lambda f: rewrite(f, lattice=lattice(nodes=[1, 12])),
        r"lattice of \(1, 12\) nodes; a lattice must have at least two",
    ),
    (
        lambda f: rewrite(f, lattice=lattice(high_n=[2.5, -2.0])),
        r"lattice from \[0.5, -1.0\] to \[2.5, -2.0\] N",
    ),
    (lambda f: rewrite(f, lattice=lattice(low_n=[0.5, float("nan")])), "must have two corners"),
    (lambda f: rewrite(f, lattice=lattice(low_n=[0.5])), "must have two corners"),
    (lambda f: weights(f, actions=None), "actions"),
    (lambda f: weights(f, actions=np.full((3, 4, 6, 2), np.nan, np.float32)), "not finite"),
    (lambda f: weights(f, force_n=np.zeros((3, 4), np.float32)), "do not fit"),
]


@pytest.mark.parametrize(("harm", "message"), HARMS)
def test_a_damaged_folder_is_refused_in_one_line(harm: Any, message: str, tmp_path: Path) -> None:
    for folder, load in ((save(tmp_path), load_map), (save_controller(tmp_path), load_controller)):
        harm(folder)
        with pytest.raises(ArtifactError, match=message) as raised:
            load(folder)
        assert "\n" not in str(raised.value)
        assert str(folder) in str(raised.value)


def test_a_controllers_folder_is_no_map(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match=r"not a map: it contains no map\.json"):
        load_map(save_controller(tmp_path))


def test_a_map_is_known_of_the_very_plant_that_it_was_made_of(tmp_path: Path) -> None:
    fin = StrokeFin()
    config = MapConfig(spacing_n=0.25)
    save_map(tmp_path / "map", KNOWN, config, PAPER_LIMITS, {"plant_identity": identity(fin)})
    loaded = load_force_map(tmp_path / "map", fin, "mine")
    jax.tree.map(np.testing.assert_array_equal, loaded.force_map.gaits, KNOWN.gaits)
    assert loaded.config == config
    with pytest.raises(
        ArtifactError,
        match=r"belongs to another plant .* than those of other .*; map this plant: softfin map other --out DIR",
    ):
        load_force_map(tmp_path / "map", AnalyticFin(), "other")
