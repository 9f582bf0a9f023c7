"""Damaged folders end in one line of ArtifactError."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError
from tests.control.folders import KINDS, folder_option


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    out = tmp_path_factory.mktemp("controllers")
    return {kind: folder_option(kind, out) for kind in KINDS}


def copied(folder: Path, to: Path) -> Path:
    """The two files."""
    to.mkdir(exist_ok=True)
    for name in ("controller.json", "weights.safetensors"):
        (to / name).write_bytes((folder / name).read_bytes())
    return to


def edit(folder: Path, **changes: Any) -> None:
    file = folder / "controller.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def weigh(folder: Path, **changes: Any) -> None:
    file = folder / "weights.safetensors"
    arrays = safetensors.numpy.load(file.read_bytes())
    file.write_bytes(
        safetensors.numpy.save(
            {**arrays, **{name.replace("__", "."): x for name, x in changes.items()}}
        )
    )


@pytest.mark.parametrize(
    ("kind", "harm", "message"),
    [
        (
            "single",
            lambda f: (f / "weights.safetensors").unlink(),
            "weights.safetensors: missing; copy the whole",
        ),
        (
            "single",
            lambda f: (f / "weights.safetensors").write_bytes(b"12"),
            "truncated or damaged",
        ),
        (
            "single",
            lambda f: (f / "controller.json").unlink(),
            "not a controller: it contains no controller.json",
        ),
        ("single", lambda f: (f / "controller.json").write_text("{"), "cannot be read as JSON"),
        (
            "single",
            lambda f: (f / "controller.json").write_text("[" * 100_000),
            "cannot be read as JSON",
        ),
        (
            "single",
            lambda f: (f / "controller.json").write_text("[]"),
            "must contain a JSON object",
        ),
        ("single", lambda f: edit(f, limits={}), "angle_min_rad is missing; it must be"),
        (
            "single",
            lambda f: edit(f, task={"past_actions": -1}),
            "past_actions is -1: Input should be greater than or equal to 0",
        ),
        (
            "single",
            lambda f: edit(f, task={"past_actions": 5}),
            r"net.lstm.kernel has shape .* requires \(15",
        ),
        (
            "gaits",
            lambda f: edit(f, lattice={"low_n": [0, 0], "high_n": [1, 1], "nodes": [9999, 9999]}),
            "do not fit a lattice of .9999",
        ),
        ("single", lambda f: edit(f, cells=[]), "cells: got 0; a single controller must have one"),
        (
            "single",
            lambda f: edit(f, controller="neither"),
            "'neither', must be one of single, grid, gaits",
        ),
        (
            "single",
            lambda f: edit(f, format=4),
            "format is '4', but this softfin reads 3",
        ),
        (
            "single",
            lambda f: weigh(f, more=np.zeros(2, np.float32)),
            "missing or unknown weights: more",
        ),
        (
            "single",
            lambda f: weigh(f, log_std=np.array([0, np.nan], np.float32)),
            "numbers that are not finite",
        ),
        (
            "gaits",
            lambda f: weigh(f, actions=np.full((3, 4, 6, 2), 1.1, np.float32)),
            r"actions are outside \[-1",
        ),
        (
            "grid",
            lambda f: edit(f, reachable={"centre_n": [0, 0], "radius_n": [1, -1, 1]}),
            "none of them negative",
        ),
        ("gaits", lambda f: edit(f, reachable=None), "reachable = None: must be an object"),
        (
            "gaits",
            lambda f: edit(f, lattice={"low_n": [0.5, 0], "high_n": [2.5, -2], "nodes": [3, 4]}),
            r"lattice from \[0.5, 0.0\] to \[2.5, -2.0\] N: must have two corners",
        ),
        (
            "gaits",
            lambda f: edit(f, lattice={"low_n": [0, 0], "high_n": [1, 1], "nodes": [1, 12]}),
            "must have at least two nodes per side",
        ),
        (
            "gaits",
            lambda f: weigh(f, force_n=np.zeros((3, 4), np.float32)),
            "do not fit a lattice of .3, 4. nodes",
        ),
        ("grid", lambda f: edit(f, fin=3), "is 3: Input should be a valid string"),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(
    kind: str, harm: Callable[[Path], Any], message: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders[kind], tmp_path / "c")
    harm(folder)
    with pytest.raises(ArtifactError, match=message) as error:
        load_controller(folder)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no such folder; it must be a controller"):
        load_controller(tmp_path / "none")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"angle_min_rad": -100.0, "angle_max_rad": 100.0},
            "limits: angle_min_rad is -100; a fin's limits must be finite",
        ),
        (
            {"velocity_max_rad_s": 9000.0},
            "limits: velocity_max_rad_s is 9000; a fin's limits must be finite",
        ),
        ({"velocity_min_rad_s": 60.0}, "limits: velocity_min_rad_s is 60"),
    ],
)
def test_limits_that_no_fin_has_are_refused(
    changes: dict[str, float], words: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders["single"], tmp_path / "c")
    edit(folder, limits=json.loads((folder / "controller.json").read_text())["limits"] | changes)
    with pytest.raises(ArtifactError, match=words) as error:
        load_controller(folder)
    assert str(folder / "controller.json") in str(error.value)
    assert "velocity_max <= 50 rad/s" in str(error.value)
