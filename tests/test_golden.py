"""Files that softfin wrote before are loaded and do what they did: `tests/golden` holds one of each
kind, frozen."""

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from mcap.records import Channel

import softfin
from softfin import cli
from softfin.control.controller import Measured
from softfin.control.family import load_family
from softfin.core.quantities import Command
from softfin.rig.config import load_rig, load_ros2
from softfin.storage import artifact as artifacts
from softfin.storage.bag.recovery import scan
from softfin.storage.formats import FOLDERS, FORMATS, IN_FILE
from softfin.task.signals import read_reference_file
from tests.documents import ROOT

GOLDEN = Path(__file__).parent / "golden"
NUMBERED = GOLDEN / "numbered"
"""From when every kind had a number."""
EXPECTED = json.loads((GOLDEN / "expected.json").read_text())
ARRAYS = np.load(GOLDEN / "expected.npz")
CONTROLLERS = ("single", "grid", "gaits")
EXACT = {"rtol": 1e-6, "atol": 1e-6}
FREE_RUNNING = {"rtol": 5e-6, "atol": 5e-6}
"""Rounding, which depends on how a program is compiled, adds up over 300 samples."""


def readings(plant: Any, actions: int) -> np.ndarray:
    """Angle, its change and force of a plant while it is sent fixed commands, each for 33
    samples."""
    hold = jax.jit(lambda state, command: plant.advance(state, command, 33))
    state = plant.init(jax.random.key(0))
    rows = []
    for k in range(actions):
        command = Command(jnp.float32(0.9 * np.sin(2.1 * k)), jnp.float32(1.5 + 0.5 * np.cos(k)))
        state, reading = hold(state, command)
        rows.append(np.column_stack([reading.angle, reading.velocity / 100, reading.force]))
    return np.concatenate(rows)


def played() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles, forces and references of 60 actions; the references switch between the two cells of
    the grid."""
    k = np.arange(60)
    references = (
        np.where((k // 11 % 2 == 0)[:, None], (1.2, -0.8), (-0.2, 0.1)) + 0.05 * np.sin(k)[:, None]
    )
    forces = references + np.stack([np.sin(1.3 * k), np.cos(0.7 * k)], axis=1)
    return tuple(
        np.asarray(part, np.float32) for part in (1.2 * np.sin(0.9 * k), forces, references)
    )


def commands(controller: Any) -> np.ndarray:
    """Angles and velocities that a trained controller commands."""
    act = jax.jit(
        lambda state, angle, force, reference: controller.act(
            state, Measured(angle, force), reference
        )
    )
    state = controller.init()
    given = []
    for now in zip(*played(), strict=True):
        state, command = act(state, *now)
        given.append((command.angle, command.velocity))
    return np.array(given)


def numpy_commands(folder: Path) -> np.ndarray:
    """The same with NumPy alone."""
    controller = softfin.load_controller(folder)
    state = controller.init()
    given = []
    for angle, force, reference in zip(*(part.tolist() for part in played()), strict=True):
        state, target = controller.act(state, Measured(angle, tuple(force)), tuple(reference))
        given.append((target.angle, target.velocity))
    return np.array(given)


def summary(log: softfin.Log) -> list[float]:
    """Number of rows, then mean and deviation of each channel."""
    channels = np.column_stack(
        [*log.command, log.reading.time, log.reading.angle, log.reading.force]
    ).astype(float)
    return [len(channels), *channels.mean(axis=0), *channels.std(axis=0)]


def test_dataset() -> None:
    dataset = softfin.Dataset.open(GOLDEN / "dataset")
    assert dataset.data_hash == EXPECTED["data_hash"]
    found = [summary(log) for log in dataset.load((*dataset.train, *dataset.test))]
    np.testing.assert_allclose(found, EXPECTED["dataset"], **EXACT)


@pytest.mark.parametrize("name", ["paper", "streaming"])
def test_surrogate(name: str) -> None:
    np.testing.assert_allclose(
        readings(softfin.load_surrogate(GOLDEN / name), 9), ARRAYS[name], **FREE_RUNNING
    )


def test_calibrated_tank() -> None:
    description = yaml.safe_load((GOLDEN / "calibration/tank.yaml").read_text())
    # Since then the sensor of every tank is zeroed before an experiment.
    description.setdefault("sensor", {})["zero_s"] = 0.0
    tank = softfin.Tank(softfin.TankConfig.build(description))
    np.testing.assert_allclose(readings(tank, 3), ARRAYS["tank"], **FREE_RUNNING)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_controller(name: str) -> None:
    np.testing.assert_allclose(
        commands(softfin.load_controller(GOLDEN / name)), ARRAYS[name], **EXACT
    )
    np.testing.assert_allclose(numpy_commands(GOLDEN / name), ARRAYS[name], **EXACT)


def test_family() -> None:
    controller = softfin.load_controller(GOLDEN / "gaits")
    family = load_family(GOLDEN / "gaits", controller)
    assert family is not None
    assert family.coefficients == 2
    assert family.nominal.shape == (3, 3, 6, 7)


def test_reachable_forces() -> None:
    gaits = softfin.load_controller(GOLDEN / "gaits")
    assert gaits.reachable is not None
    np.testing.assert_allclose(gaits.reachable.radius, EXPECTED["radius_n"], **EXACT)
    np.testing.assert_allclose(gaits.limits, EXPECTED["limits"], **EXACT)


def test_evaluation(tmp_path: Path) -> None:
    before = json.loads((GOLDEN / "evaluation/evaluation.json").read_text())
    config = softfin.EvaluateConfig(references=((1, -1),), seconds=6, seeds=1)
    softfin.evaluate(
        GOLDEN / "single",
        plant=str(GOLDEN / "streaming"),
        out=tmp_path / "evaluation",
        config=config,
    )
    now = json.loads((tmp_path / "evaluation/evaluation.json").read_text())
    for axis, scores in before["references"][0].items():
        if axis in ("x", "y"):
            for name, value in (
                (name, value) for name, value in scores.items() if value is not None
            ):
                np.testing.assert_allclose(
                    now["references"][0][axis][name], value, **EXACT, err_msg=name
                )


def test_bag(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    # Without its end, as after a power cut.
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((GOLDEN / "session.mcap").read_bytes()[:-40])
    out = str(tmp_path / "saved.mcap")
    cli.main(["bag", "recover", str(cut), "--out", out, "--json"])
    assert json.loads(capsys.readouterr().out)["messages"] == EXPECTED["messages"]
    options = softfin.ImportConfig(ignore_errors="all")
    softfin.import_logs(GOLDEN / "session.mcap", out=tmp_path / "dataset", recordings=options)
    dataset = softfin.Dataset.open(tmp_path / "dataset")
    found = [summary(log) for log in dataset.load(dataset.train)]
    np.testing.assert_allclose(found, EXPECTED["bag"], **EXACT)


def test_rig_files() -> None:
    assert load_rig(GOLDEN / "rig.yaml").fin == "blue-30A"
    assert load_rig(GOLDEN / "rig.yaml").model_dump(mode="json") == EXPECTED["rig"]
    assert load_ros2(GOLDEN / "ros2.yaml").model_dump(mode="json") == EXPECTED["ros2"]


def test_emulated_rig_is_as_it_was_left(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("emulated.yaml", "emulated.state.json"):
        shutil.copy(GOLDEN / name, tmp_path)
    cli.main(["rig", "check", "--rig", str(tmp_path / "emulated.yaml"), "--json"])
    checks = {row["what"]: row for row in json.loads(capsys.readouterr().out)}
    assert checks["zero"]["state"] == "well"
    assert checks["angle"]["text"].startswith("+1.143 rad")


def test_references() -> None:
    recorded = read_reference_file(GOLDEN / "references.csv")
    assert recorded.time_s == (0, 1.5, 3)
    assert recorded.force_n == ((1, -1), (0.9, -0.8), (0, 0.25))


def numbers() -> set[tuple[str, int]]:
    """Kind and format number of every golden file."""
    found = set()
    for kind in FOLDERS:
        found |= {
            (kind, json.loads(file.read_text()).get("format", 1))
            for file in GOLDEN.rglob(f"{kind}.json")
        }
    for file in GOLDEN.rglob("*.parquet"):
        found.add(("log", int((pq.read_schema(file).metadata or {}).get(IN_FILE.encode(), b"1"))))
    for file in GOLDEN.rglob("*.mcap"):
        channels = (item for item in scan(file) if isinstance(item, Channel))
        found |= {("recording", int(channel.metadata.get(IN_FILE, "1"))) for channel in channels}
    return found


def test_there_is_a_file_of_each_kind_and_of_each_format_that_is_read() -> None:
    assert numbers() >= set(FORMATS.items()), "add a golden file of the new format"


@pytest.mark.parametrize("file", sorted(NUMBERED.glob("*/*.json")), ids=lambda file: file.name)
def test_each_description_is_read(file: Path) -> None:
    kind = json.loads(file.read_text())["kind"]
    assert artifacts.load_description(file.parent, kind)["kind"] == kind


WRITTEN_ONLY = ("inspection", "evaluation", "benchmark", "calibration", "robot")
"""Kinds that softfin itself does not read, but other programs do."""


def check_keys(folder: Path) -> None:
    """A folder that was written just now has what the golden one of its kind and format has, and
    maybe more."""
    for kind in WRITTEN_ONLY:
        if artifacts.is_kind(folder, kind):
            now = artifacts.load_description(folder, kind)
            # Those before numbers were written have keys that softfin had dropped by then.
            golden = [
                json.loads(file.read_text()) for file in sorted(NUMBERED.rglob(f"{kind}.json"))
            ]
            before = next(each for each in golden if each["format"] == now["format"])
            gone = before.keys() - now.keys()
            assert not gone, f"{kind}.json has lost {gone}: write them, or a new format"


def test_a_dataset_and_a_recording_with_numbers(tmp_path: Path) -> None:
    expected = json.loads((NUMBERED / "expected.json").read_text())
    dataset = softfin.Dataset.open(NUMBERED / "dataset")
    assert dataset.data_hash == expected["data_hash"]
    found = [summary(log) for log in dataset.load((*dataset.train, *dataset.test))]
    np.testing.assert_allclose(found, expected["dataset"], **EXACT)
    options = softfin.ImportConfig(shortest_s=1, ignore_errors="all")
    softfin.import_logs(NUMBERED / "session.mcap", out=tmp_path / "dataset", recordings=options)
    recorded = softfin.Dataset.open(tmp_path / "dataset")
    np.testing.assert_allclose(
        [summary(log) for log in recorded.load(recorded.train)], expected["recording"], **EXACT
    )


def test_the_example_of_that_time_lists_what_it_held() -> None:
    description = artifacts.load_description(NUMBERED / "example", "example")
    now = artifacts.load_description(ROOT / "src/softfin/example", "example")
    assert description.keys() <= now.keys()
    assert description["files"].keys() <= now["files"].keys()
