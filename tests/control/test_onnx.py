"""The exported step is the native one, and says what it is."""

import importlib
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest

from softfin.cli import main
from softfin.control import onnx as exporting
from softfin.control.controller import Measured
from softfin.control.onnx import export_onnx
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError, ConfigurationError, RunError
from tests.control.folders import KINDS, folder_option


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    out = tmp_path_factory.mktemp("controllers")
    return {kind: folder_option(kind, out) for kind in KINDS}


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_from_the_metadata_alone_is_the_native_one(
    kind: str, folders: dict[str, Path], tmp_path: Path
) -> None:
    controller = load_controller(folders[kind])
    file = tmp_path / "c.onnx"
    exported = export_onnx(controller, file)
    assert exported.bytes == file.stat().st_size
    assert exported.worst < 1e-5
    session = onnxruntime.InferenceSession(file.read_bytes(), providers=["CPUExecutionProvider"])
    said = session.get_modelmeta().custom_metadata_map
    types = {"tensor(float)": np.float32, "tensor(int64)": np.int64}
    after = json.loads(said["state"])
    state: dict[str, Any] = {
        each.name: np.array(json.loads(said[f"initial_{each.name}"]), types[each.type]).reshape(
            each.shape
        )
        for each in session.get_inputs()
        if each.name in after
    }
    numbers = np.random.default_rng(4)
    native = controller.init()
    for index in range(60):
        angle = float(numbers.uniform(-1, 1))
        reference = (1.5 + np.sin(index / 9), np.cos(index / 5))
        fed = {"angle": angle, "force": (0, 0), "reference": reference}
        found = dict(
            zip(
                [each.name for each in session.get_outputs()],
                session.run(
                    None, {name: np.array(x, np.float32) for name, x in fed.items()} | state
                ),
                strict=True,
            )
        )
        state = {name: found[output] for name, output in after.items()}
        native, target = controller.act(
            native, Measured(angle, (0.0, 0.0)), (float(reference[0]), float(reference[1]))
        )
        np.testing.assert_allclose(
            (found["command_angle"], found["command_velocity"]), target, atol=2e-5
        )


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["angle", "reference"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_an_unusable_input_repeats_the_last_command_and_leaves_the_state_as_it_is(
    kind: str, name: str, bad: float, folders: dict[str, Path], tmp_path: Path
) -> None:
    export_onnx(load_controller(folders[kind]), tmp_path / "c.onnx")
    session = onnxruntime.InferenceSession(tmp_path / "c.onnx", providers=["CPUExecutionProvider"])
    said = session.get_modelmeta().custom_metadata_map
    after = json.loads(said["state"])
    state: dict[str, np.ndarray] = {}
    good = {
        "angle": np.array(0.3, np.float32),
        "force": np.zeros(2, np.float32),
        "reference": np.array((1.5, 0.5), np.float32),
    }
    for each in session.get_inputs():
        if each.name in after:
            kind_of = np.int64 if "int64" in each.type else np.float32
            state[each.name] = np.array(json.loads(said[f"initial_{each.name}"]), kind_of).reshape(
                each.shape
            )
    outputs = [each.name for each in session.get_outputs()]

    def step(fed: dict[str, Any]) -> dict[str, np.ndarray]:
        return dict(zip(outputs, session.run(None, fed), strict=True))

    before = step(good | state)
    state = {each: before[output] for each, output in after.items()}
    held = step(good | {name: np.full_like(good[name], bad)} | state)
    assert held["command_angle"] == before["command_angle"]
    assert held["command_velocity"] == before["command_velocity"]
    for each, output in after.items():
        np.testing.assert_array_equal(held[output], state[each])


def test_the_file_says_what_it_is(folders: dict[str, Path], tmp_path: Path) -> None:
    controller = load_controller(folders["grid"])
    export_onnx(controller, tmp_path / "c.onnx")
    model = onnx.load(tmp_path / "c.onnx")
    assert [(each.domain, each.version) for each in model.opset_import] == [("", 21)]
    said = {each.key: each.value for each in model.metadata_props}
    assert said["kind"] == "grid"
    assert said["weights_sha256"] == controller.artifact.weights_sha256
    assert said["action_rate_hz"] == "3.0"
    assert json.loads(said["action_ticks_of_10_ms"]) == [33, 33, 34]
    assert json.loads(said["limits"]) == controller.limits.to_dict()
    assert len(json.loads(said["cells_n"])) == 6
    assert "thrust" in said["force_frame"]


def test_commands_stay_within_the_limits_in_single_precision(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    controller = load_controller(folders["gaits"])
    export_onnx(controller, tmp_path / "c.onnx")
    session = onnxruntime.InferenceSession(
        str(tmp_path / "c.onnx"), providers=["CPUExecutionProvider"]
    )
    limits = controller.limits
    far = np.array([1e6, -1e6], np.float32)
    for age in range(6):
        fed = {"angle": far[0], "force": far, "reference": far, "age": np.array(age)}
        fed["last_command"] = np.zeros(2, np.float32)
        angle, velocity, *_ = session.run(
            None, {name: np.asarray(value) for name, value in fed.items()}
        )
        assert limits.angle_min <= float(angle) <= limits.angle_max
        assert limits.velocity_min <= float(velocity) <= limits.velocity_max


def test_a_file_that_is_not_the_native_step_is_not_written(
    folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(exporting, "MAX_COMMAND_DIFFERENCE", -1.0)
    with pytest.raises(
        RunError,
        match=r"not written: the commands from onnxruntime differ .*limit .*; use a different version",
    ):
        export_onnx(load_controller(folders["gaits"]), tmp_path / "c.onnx")
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_kept_unless_it_may_be_replaced(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    file = tmp_path / "c.onnx"
    controller = load_controller(folders["gaits"])
    file.write_text("mine")
    with pytest.raises(
        ArtifactError, match="already exists; choose a different --onnx, or use --overw"
    ):
        export_onnx(controller, file)
    with pytest.raises(ArtifactError, match="is not a file"):
        export_onnx(controller, tmp_path, overwrite=True)
    export_onnx(controller, file, overwrite=True)
    onnx.checker.check_model(str(file))


@pytest.mark.parametrize("name", ["ndonnx", "onnx", "onnxruntime"])
def test_without_the_extra_one_line_says_how_to_get_it(
    name: str, folders: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        ConfigurationError, match=r"ONNX needs .*, which is not installed; .*pip install .*\[onnx\]"
    ):
        export_onnx(load_controller(folders["gaits"]), tmp_path / "c.onnx")


def test_the_command_line_tells_the_signature(
    folders: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["export", str(folders["gaits"]), "--onnx", str(tmp_path / "c.onnx"), "--json"])
    said = json.loads(capsys.readouterr().out)
    assert said["inputs"] == ["angle", "force", "reference", "age", "last_command"]
    state = ["next_age", "next_last_command"]
    assert said["outputs"] == ["command_angle", "command_velocity", *state]
    assert said["worst"] < 1e-5
    with pytest.raises(SystemExit) as stop:
        main(["export", str(folders["gaits"]), "--onnx", str(tmp_path / "c.onnx")])
    assert stop.value.code == 2
    assert "already exists" in capsys.readouterr().err


def test_the_module_can_be_imported_without_the_extra() -> None:
    for name in ("ndonnx", "onnxruntime"):
        assert name not in vars(importlib.import_module("softfin.control.onnx"))
