"""The exported step is the surrogate's own, says what it is, and runs as the documents show."""

import json
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from jax.flatten_util import ravel_pytree

from softfin.cli import main
from softfin.core.errors import ArtifactError, RunError
from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.storage.onnx_file import OPSET
from softfin.storage.onnx_graph import build_graph
from softfin.surrogate import load_surrogate, save_surrogate
from softfin.surrogate import onnx as exporting
from softfin.surrogate.onnx import export_surrogate
from tests.documents import blocks
from tests.surrogate import small as paper
from tests.surrogate.streaming import small as streaming

MODELS = {"streaming": streaming.surrogate, "paper": paper.surrogate}
TICKS = 120


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Folder and file of each model."""
    root = tmp_path_factory.mktemp("surrogates")
    for name, build in MODELS.items():
        save_surrogate(root / name, build(), None, {})
        assert export_surrogate(root / name, root / f"{name}.onnx").worst < 1e-3
    return root


def run(file: Path, commands: Command) -> dict[str, np.ndarray]:
    """All outputs of a free run, by what the metadata says."""
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    metadata = session.get_modelmeta().custom_metadata_map
    (name, after) = next(iter(json.loads(metadata["state"]).items()))
    state = np.array(json.loads(metadata[f"initial_{name}"]), np.float32)
    rows = []
    names = [each.name for each in session.get_outputs()]
    for angle, velocity in zip(*commands, strict=True):
        given = {
            "command_angle": np.asarray(angle),
            "command_velocity": np.asarray(velocity),
            name: state,
        }
        rows.append(dict(zip(names, session.run(None, given), strict=True)))
        state = rows[-1][after]
    return {name: np.stack([row[name] for row in rows]) for name in names}


@pytest.mark.parametrize("name", MODELS)
def test_a_free_run_from_the_metadata_alone_is_the_surrogates(name, exported):
    surrogate = load_surrogate(exported / name)
    low, high, slow, fast = surrogate.limits
    k = np.arange(TICKS)
    angle = (low + high) / 2 + 0.4 * (high - low) * np.sign(np.sin(0.1 * k))
    commands = Command(
        *(np.asarray(x, np.float32) for x in (angle, slow + (fast - slow) * (k % 40) / 40))
    )
    found = run(exported / f"{name}.onnx", commands)
    end, reading = jax.jit(lambda start: roll(surrogate, start, commands))(
        surrogate.init(jax.random.key(0))
    )
    for channel, expected in (
        ("angle", reading.angle),
        ("velocity", reading.velocity),
        ("force", reading.force),
    ):
        np.testing.assert_allclose(found[channel], expected, atol=2e-4, err_msg=channel)
    np.testing.assert_allclose(found["next_state"][-1], ravel_pytree(end[1:])[0], atol=2e-4)
    if name == "streaming":
        assert found["force_members"].shape == (TICKS, surrogate.size, 2)
        np.testing.assert_allclose(found["force_members"].mean(axis=1), found["force"], atol=1e-5)
        np.testing.assert_allclose(found["distance"][-1], surrogate.distance(end), rtol=1e-4)


@pytest.mark.parametrize("name", MODELS)
def test_the_file_says_what_it_is(name, exported):
    model = onnx.load(exported / f"{name}.onnx")
    assert [(each.domain, each.version) for each in model.opset_import] == [("", OPSET)]
    metadata = {each.key: each.value for each in model.metadata_props}
    assert (metadata["model"], metadata["rate_hz"]) == (name, "100")
    assert json.loads(metadata["limits"]) == load_surrogate(exported / name).limits.to_dict()
    described = (
        json.loads(metadata["inputs"])
        | json.loads(metadata["outputs"])
        | json.loads(metadata["state"])
    )
    names = {each.name for each in (*model.graph.input, *model.graph.output)}
    assert names == described.keys() | {"next_state"}
    assert "thrust" in metadata["force_frame"]


def test_what_the_documents_show_runs(exported, tmp_path, monkeypatch, capsys):
    (block,) = [
        block for block in blocks() if block.kind == "python" and "onnxruntime" in block.text
    ]
    (tmp_path / "surrogate.onnx").symlink_to(exported / "streaming.onnx")
    monkeypatch.chdir(tmp_path)
    names: dict[str, np.ndarray] = {}
    exec(compile(block.text, block.document, "exec"), names)
    k = np.arange(300)
    commands = Command((0.8 * np.sin(0.06 * k)).astype(np.float32), np.full(300, 3, np.float32))
    found = run(exported / "streaming.onnx", commands)
    np.testing.assert_array_equal(names["found"]["force"], found["force"][-1])
    assert str(found["force"][-1]) in capsys.readouterr().out


def test_a_file_that_is_not_the_surrogates_step_is_not_written(exported, tmp_path, monkeypatch):
    monkeypatch.setattr(exporting, "MAX_READING_DIFFERENCE", -1.0)
    with pytest.raises(
        RunError, match=r"not written: onnxruntime's readings differ from softfin's by"
    ):
        export_surrogate(exported / "streaming", tmp_path / "s.onnx")
    assert not list(tmp_path.iterdir())


def test_what_is_there_is_kept_unless_it_may_be_replaced(exported, tmp_path):
    (tmp_path / "s.onnx").write_text("mine")
    with pytest.raises(
        ArtifactError, match="already exists; choose another --onnx, or use --overw"
    ):
        export_surrogate(exported / "paper", tmp_path / "s.onnx")
    assert (tmp_path / "s.onnx").read_text() == "mine"


def test_the_command_line_takes_a_controller_or_a_surrogate(exported, tmp_path, capsys):
    out = ["--onnx", str(tmp_path / "s.onnx")]
    main(["export", "--surrogate", str(exported / "paper"), *out, "--json"])
    found = json.loads(capsys.readouterr().out)
    assert found["inputs"] == ["command_angle", "command_velocity", "state"]
    assert found["outputs"] == ["angle", "velocity", "force", "next_state"]
    for words in ((), (str(exported), "--surrogate", str(exported / "paper"))):
        with pytest.raises(SystemExit) as stop:
            main(["export", *words, *out])
        assert stop.value.code == 2
        assert "use either CONTROLLER or --surrogate DIR" in capsys.readouterr().err


X = np.linspace(-2, 2, 12, dtype=np.float32).reshape(3, 4)
Y = np.linspace(1, 3, 24, dtype=np.float32).reshape(3, 4, 2)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: jnp.einsum("ij,ijk->ik", x, y),
        lambda x, y: jnp.einsum("ij,kjl->lki", x, y),
        lambda x, y: jnp.tensordot(x, y, axes=[[0, 1], [0, 1]]),
        lambda x, y: x @ (2 * np.ones((4, 3), np.float32)) + y[0, 0, 0],
        lambda x, y: jnp.concatenate([x[:, ::2], y[:, 1:3, 0]], axis=1),
        lambda x, y: jnp.where(x > 0, x**3, -jnp.abs(x)) + y[..., 1],
        lambda x, y: jnp.stack([jnp.minimum(x, 0.5), jnp.maximum(x, y[..., 0])], axis=1),
        lambda x, y: x[:, np.array([3, 0, 0])] + jnp.sum(y, axis=(1, 2))[:, None],
        lambda x, y: jax.lax.dynamic_slice(x, (1, 1), (2, 2)) * jax.nn.sigmoid(y[:2, :2, 0]),
        lambda x, y: jax.lax.dynamic_slice(x, (y[0, 0, 0].astype(int), jnp.int32(9)), (2, 1)),
        lambda x, y: x[jnp.argmin(y[:, 0, 0])] * (jnp.argmin(x[0]) != 1),
        lambda x, y: jnp.arctanh(x / 3) + jax.lax.rem(x, jnp.float32(0.3)),
        lambda x, y: (x > 0) & (x != 2) & (jax.lax.rem(x.astype(int), 2) == -1),
        lambda x, y: jnp.tile(jnp.square(x).T, (2, 1)) - y[0, 0, 0],
        lambda x, y: jax.lax.scan(lambda a, b: (a + b.sum(), a * b), x[0, 0], y)[1],
        lambda x, y: jax.lax.scan(lambda a, b: (a + b.sum(), a), x[0, 0], y, reverse=True)[1],
        lambda x, y: jax.nn.relu(
            jnp.log(y) * jnp.exp(x[..., None]) / jnp.sqrt(y) + jnp.sign(x)[..., None]
        ),
    ],
)
def test_each_primitive_is_translated_as_jax_computes_it(function):
    model = build_graph(lambda x, y: {"out": function(x, y)}, {"x": X, "y": Y})
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), providers=["CPUExecutionProvider"]
    )
    np.testing.assert_allclose(
        session.run(None, {"x": X, "y": Y})[0], function(X, jnp.asarray(Y)), rtol=1e-5, atol=1e-6
    )


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: jnp.sort(x),
        lambda x, y: x[y[0, :, 0].astype(int)],
    ],
)
def test_a_primitive_that_is_not_translated_is_refused_in_one_line(function):
    with pytest.raises(RunError, match=r"^ONNX: .*softfin can"):
        build_graph(lambda x, y: {"out": function(x, y)}, {"x": X, "y": Y})
