"""Damaged and hostile folders: one line of ArtifactError, or a controller that keeps within its limits."""

import json
import os
import random
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from softfin.control.native import files as native_files
from softfin.control.native import load_native, trimmed
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError
from tests.control.native.folders import KINDS, folder_of

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 600

ODD: tuple[Any, ...] = (
    None, True, -1, 0, 1, 2, 3, 7, 0.5, 1e-300, 1e300, 10**9, 10**400, -(10**30), float("nan"), float("inf"), "", "x",
    "\u0000\n", [], {}, [1], [1, 2], [[]], {"low": [0, 0], "high": [1, 1]}, [1e38, -1e38], "single", "grid", "gaits",
)  # fmt: skip
"""What values may become."""


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    out = tmp_path_factory.mktemp("controllers")
    return {kind: folder_of(kind, out) for kind in KINDS}


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
    file.write_bytes(safetensors.numpy.save({**arrays, **{name.replace("__", "."): x for name, x in changes.items()}}))


@pytest.mark.parametrize(
    ("kind", "harm", "message"),
    [
        ("single", lambda f: (f / "weights.safetensors").unlink(), "weights.safetensors: missing; copy the whole"),
        ("single", lambda f: (f / "weights.safetensors").write_bytes(b"12"), "truncated or damaged"),
        ("single", lambda f: (f / "controller.json").unlink(), "not a controller: it holds no controller.json"),
        ("single", lambda f: (f / "controller.json").write_text("{"), "not readable as JSON"),
        ("single", lambda f: (f / "controller.json").write_text("[" * 100_000), "not readable as JSON"),
        ("single", lambda f: (f / "controller.json").write_text("[]"), "holds no object"),
        ("single", lambda f: edit(f, limits={}), "angle_min_rad is missing; it must be"),
        (
            "single",
            lambda f: edit(f, task={"past_actions": -1}),
            "past_actions is -1; it must be a whole number from 0",
        ),
        ("single", lambda f: edit(f, task={"past_actions": 5}), r"net.lstm.kernel has shape .* needs \(15"),
        ("single", lambda f: edit(f, policy={"units": 10**9}), "units is 1000000000; it must be a whole number from 1"),
        ("gaits", lambda f: edit(f, lattice={"low_n": [0, 0], "high_n": [1, 1], "nodes": [9999, 9999]}), "needs .9999"),
        ("single", lambda f: edit(f, cells=[]), r"cells is \[\]; it must be a list of one cell or more"),
        ("single", lambda f: edit(f, controller="neither"), "'neither'; it must be single, grid or gaits"),
        ("single", lambda f: edit(f, format=3), "format is 3; it must be 2 for this softfin: update it"),
        ("single", lambda f: edit(f, action_rate_hz=5.0), "action_rate_hz is 5.0; it must be 3.0 Hz"),
        ("single", lambda f: weigh(f, more=np.zeros(2, np.float32)), "weights more are missing or unknown"),
        ("single", lambda f: weigh(f, log_deviation=np.array([0, np.nan], np.float32)), "not finite or beyond"),
        ("single", lambda f: weigh(f, log_deviation=np.zeros(2, np.int32)), "of type int32; weights are float32"),
        ("gaits", lambda f: weigh(f, actions=np.full((3, 4, 6, 2), 1.1, np.float32)), r"gaits beyond \[-1, 1\]"),
        (
            "grid",
            lambda f: edit(f, reachable={"centre_n": [0, 0], "radius_n": [1, -1, 1]}),
            "radius_n is .* 0 .. 10000",
        ),
        ("grid", lambda f: edit(f, switching={"step_n": 0}), "step_n is 0; it must be"),
        ("grid", lambda f: edit(f, training_range={"angle_rad": [1, 0]}), "angle_rad is .* least and greatest"),
        ("grid", lambda f: edit(f, fin=3), "fin is 3; it must be a string or null"),
    ],
)
def test_a_damaged_folder_is_refused_in_one_line(
    kind: str, harm: Callable[[Path], Any], message: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders[kind], tmp_path / "c")
    harm(folder)
    with pytest.raises(ArtifactError, match=message) as error:
        load_native(folder)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


def test_a_folder_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ArtifactError, match="no such folder; it should be a controller"):
        load_native(tmp_path / "none")


def test_what_is_too_large_is_not_read(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(native_files, "LARGEST_WEIGHTS", 100)
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: cannot be read \(it has over 100 bytes\)"):
        load_native(folders["single"])


def test_whatever_is_changed_it_is_refused_or_keeps_within_its_limits(folders: dict[str, Path], tmp_path: Path) -> None:
    chance, refused, lines = random.Random(0), 0, 0
    for case in range(CASES):
        kind = chance.choice(KINDS)
        folder = copied(folders[kind], tmp_path / "c")
        for _ in range(chance.choice((1, 1, 1, 2, 5))):
            chance.choice((mutate_value, mutate_value, mutate_text, mutate_header, mutate_bytes, mutate_array))(
                folder, chance
            )
        before = {file.name: file.stat().st_size for file in folder.iterdir()}
        try:
            controller = load_native(folder)
        except ArtifactError as error:
            refused += 1
            lines += str(error).count("\n")
            continue
        finally:
            assert {file.name: file.stat().st_size for file in folder.iterdir()} == before
        limits = controller.limits
        for each in (controller, trimmed(controller)):
            state = each.init()
            for index in range(9):
                state, target = each.act(state, 3.0 * (-1) ** index, (20.0, -20.0), (index / 2, 2.0 - index))
                assert limits.angle_min <= target.angle <= limits.angle_max, case
                assert limits.velocity_min <= target.velocity <= limits.velocity_max, case
    assert lines == 0
    # Both must have happened, or the cases are worth nothing.
    assert 0.2 * CASES < refused < 0.99 * CASES


def mutate_value(folder: Path, chance: random.Random) -> None:
    """One value of the JSON that matters, anywhere in it."""
    file = folder / "controller.json"
    try:
        described = json.loads(file.read_text())
        at = described
        while True:
            inside = list(at) if isinstance(at, dict) else range(len(at))
            key = chance.choice([key for key in inside if key not in ("scores", "configuration", "provenance")])
            if not isinstance(at[key], dict | list) or not at[key] or chance.random() < 0.2:
                break
            at = at[key]
        if isinstance(at, dict) and chance.random() < 0.2:
            del at[key]
        else:
            at[key] = chance.choice(ODD)
        file.write_text(json.dumps(described))
    except (ValueError, IndexError, TypeError):
        # What an earlier mutation has made of it has no such place.
        return


def mutate_text(folder: Path, chance: random.Random) -> None:
    """Bytes of the JSON."""
    _scatter(folder / "controller.json", chance, 2000)


def mutate_bytes(folder: Path, chance: random.Random) -> None:
    """Bytes of the weights, or their end."""
    file = folder / "weights.safetensors"
    if chance.random() < 0.3:
        data = file.read_bytes()
        file.write_bytes(data[: chance.randrange(len(data) + 1)])
    else:
        _scatter(file, chance, None)


def mutate_header(folder: Path, chance: random.Random) -> None:
    """Bytes of what the weights say of themselves, or its length."""
    file = folder / "weights.safetensors"
    if chance.random() < 0.3:
        data = file.read_bytes()
        file.write_bytes(struct.pack("<Q", chance.choice((0, 1, 2**31, 2**63, len(data)))) + data[8:])
    else:
        _scatter(file, chance, 900)


def mutate_array(folder: Path, chance: random.Random) -> None:
    """Numbers, shape or type of one array."""
    file = folder / "weights.safetensors"
    try:
        arrays = safetensors.numpy.load(file.read_bytes())
        name = chance.choice(sorted(arrays))
        array = np.array(arrays[name])
        change = chance.randrange(4)
        if change == 0:
            array.reshape(-1)[chance.randrange(array.size)] = chance.choice((np.nan, np.inf, 1e38, -1e4, 1e-40, 0))
        elif change == 1:
            with np.errstate(all="ignore"):
                array = array.astype(chance.choice((np.float64, np.float16, np.int32, bool)))
        elif change == 2:
            array = array.reshape(array.shape[::-1])
        else:
            with np.errstate(all="ignore"):
                array = array * chance.choice((0, -1, 1e3, 1e30))
        file.write_bytes(safetensors.numpy.save({**arrays, name: np.asarray(array)}))
    except (safetensors.SafetensorError, KeyError, ValueError, IndexError, OverflowError):
        # What an earlier mutation has made of it has no such array.
        return


def _scatter(file: Path, chance: random.Random, within: int | None) -> None:
    data = bytearray(file.read_bytes())
    for _ in range(chance.choice((1, 1, 3))):
        if data:
            data[chance.randrange(min(within or len(data), len(data)))] = chance.randrange(256)
    file.write_bytes(data)


@pytest.mark.parametrize("loaded", [load_native, load_controller])
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"angle_min_rad": -100.0, "angle_max_rad": 100.0}, "limits: angle_min_rad is -100; a fin's are finite"),
        ({"velocity_max_rad_s": 9000.0}, "limits: velocity_max_rad_s is 9000; a fin's are finite"),
        ({"velocity_min_rad_s": 60.0}, "limits: velocity_min_rad_s is 60"),
    ],
)
def test_limits_that_no_fin_has_are_refused_by_both_loaders(
    loaded: Callable[[Path], Any], changes: dict[str, float], words: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    folder = copied(folders["single"], tmp_path / "c")
    edit(folder, limits=json.loads((folder / "controller.json").read_text())["limits"] | changes)
    with pytest.raises(ArtifactError, match=words) as error:
        loaded(folder)
    assert str(folder / "controller.json") in str(error.value)
    assert "velocity_max <= 50 rad/s" in str(error.value)
