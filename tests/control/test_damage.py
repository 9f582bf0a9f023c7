"""Damaged folders end in one line of ArtifactError."""

import json
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


def edit(folder: Path, changes: dict[str, Any]) -> None:
    """Change the description; a name without a value goes."""
    file = folder / "controller.json"
    description = json.loads(file.read_text()) | changes
    kept = {name: value for name, value in description.items() if value is not ...}
    file.write_text(json.dumps(kept))


def refusal(folder: Path) -> str:
    with pytest.raises(ArtifactError) as error:
        load_controller(folder)
    message = str(error.value)
    assert "\n" not in message
    assert len(message) < 600
    return message


FILES = [
    ("weights.safetensors", None, "missing"),
    ("weights.safetensors", "12", "truncated or damaged"),
    ("controller.json", None, "not a controller"),
    ("controller.json", "{", "JSON"),
    ("controller.json", "[" * 100_000, "JSON"),
    ("controller.json", "[]", "JSON object"),
]


@pytest.mark.parametrize(("file", "text", "words"), FILES)
def test_a_damaged_file_is_refused_in_one_line(
    file: str, text: str | None, words: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders["single"], tmp_path / "c")
    if text is None:
        (folder / file).unlink()
    else:
        (folder / file).write_text(text)
    message = refusal(folder)
    assert file in message
    assert words in message


LARGE = {"low_n": [0, 0], "high_n": [1, 1], "nodes": [9999, 9999]}
TURNED = {"low_n": [0.5, 0], "high_n": [2.5, -2], "nodes": [3, 4]}
ALONG = {"low_n": [0, 0], "high_n": [1, 1], "nodes": [1, 12]}
DESCRIPTIONS = [
    ("single", {"limits": {}}, "angle_min_rad"),
    ("single", {"limits": ...}, "limits"),
    ("single", {"task": {"past_actions": -1}}, "past_actions"),
    ("single", {"task": {"past_actions": 5}}, "net.lstm.kernel"),
    ("single", {"clock": ...}, "clock"),
    ("single", {"cells": []}, "cells: got 0"),
    ("single", {"cells": ...}, "cells"),
    ("single", {"controller": "neither"}, "'neither'"),
    ("single", {"format": 4}, "format is '4'"),
    ("single", {"format": ...}, "format is '1'"),
    ("gaits", {"lattice": LARGE}, "9999"),
    ("gaits", {"lattice": TURNED}, "(2.5, -2)"),
    ("gaits", {"lattice": ALONG}, "two nodes per side"),
    ("gaits", {"reachable": None}, "reachable = None"),
    ("grid", {"reachable": {"centre_n": [0, 0], "radius_n": [1, -1, 1]}}, "radius"),
    ("grid", {"fin": 3}, "is 3: "),
]


@pytest.mark.parametrize(("kind", "changes", "named"), DESCRIPTIONS)
def test_a_damaged_description_is_refused_by_what_is_wrong(
    kind: str, changes: dict[str, Any], named: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders[kind], tmp_path / "c")
    edit(folder, changes)
    assert named in refusal(folder)


WEIGHTS = [
    ("single", "more", np.zeros(2), "more"),
    ("single", "log_std", np.array([0, np.nan]), "not finite"),
    ("gaits", "actions", np.full((3, 4, 6, 2), 1.1), "actions"),
    ("gaits", "force_n", np.zeros((3, 4)), "lattice"),
]


@pytest.mark.parametrize(("kind", "name", "values", "named"), WEIGHTS)
def test_damaged_weights_are_refused_by_name(
    kind: str, name: str, values: Any, named: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders[kind], tmp_path / "c")
    file = folder / "weights.safetensors"
    arrays = safetensors.numpy.load(file.read_bytes())
    file.write_bytes(safetensors.numpy.save(arrays | {name: values.astype(np.float32)}))
    assert named in refusal(folder)


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    assert "no such folder" in refusal(tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "value"),
    [("angle_min_rad", -100), ("velocity_max_rad_s", 9000), ("velocity_min_rad_s", 60)],
)
def test_limits_that_no_fin_has_are_refused(
    name: str, value: float, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders["single"], tmp_path / "c")
    limits = json.loads((folder / "controller.json").read_text())["limits"]
    edit(folder, {"limits": limits | {name: value}})
    assert f"limits: {name} is {value}" in refusal(folder)
