import io
import json
import sys
import zipfile

import h5py
import jax.numpy as jnp
import numpy as np
import pytest
from examples.import_keras import main, read_keras_surrogate

from softfin.core.errors import ArtifactError, SoftfinError
from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate import load_surrogate
from tests.surrogate.paper.test_network import convolution, lstm

SCALERS = {
    name: {
        "scale": scale,
        "offset": offset,
        "data_min": -offset / scale,
        "data_max": (1 - offset) / scale,
    }
    for name, scale, offset in [
        ("command_angle_rad", 0.3, 0.5),
        ("command_velocity_rad_s", 0.6, 0.0),
        ("angle_rad", 0.31, 0.5),
        ("force_x_n", 0.03, 0.4),
        ("force_y_n", 0.026, 0.49),
    ]
}
WINDOW = 10
FIRST = "layers/conv1d/vars/0"


def write_keras(path, layers, channels, arrays):
    """A file laid out as Keras 2.15 does: layers in JSON, weights in HDF5 groups numbered within
    their class."""
    listed = [
        {
            "class_name": "InputLayer",
            "config": {"batch_input_shape": [None, channels, WINDOW], "name": "input"},
        }
    ]
    listed += [{"class_name": kind, "config": config} for kind, config in layers]
    weights = io.BytesIO()
    with h5py.File(weights, "w") as file:
        for group, values in arrays.items():
            for number, value in enumerate(values):
                file[f"layers/{group}/vars/{number}"] = value
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(
            "config.json", json.dumps({"class_name": "Sequential", "config": {"layers": listed}})
        )
        archive.writestr("metadata.json", json.dumps({"keras_version": "2.15.0"}))
        archive.writestr("model.weights.h5", weights.getvalue())


def lstm_layer(units, sequence):
    return "LSTM", {
        "units": units,
        "activation": "tanh",
        "recurrent_activation": "sigmoid",
        "return_sequences": sequence,
    }


@pytest.fixture
def files(tmp_path):
    random = np.random.default_rng(0)

    def weights(*shapes):
        return [random.normal(0, 0.4, shape).astype(np.float32) for shape in shapes]

    pos = {
        "conv1d": weights((5, WINDOW, 6), (6,)),
        "conv1d_1": weights((3, 6, 4), (4,)),
        "dense": weights((8, 5), (5,)),
        "dense_1": weights((5, 1), (1,)),
    }
    force = {
        "lstm/cell": weights((WINDOW, 24), (6, 24), (24,)),
        "lstm_1/cell": weights((6, 12), (3, 12), (12,)),
        "dense": weights((3, 5), (5,)),
        "dense_1": weights((5, 2), (2,)),
    }
    conv = {"padding": "same", "strides": [1], "activation": "relu"}
    write_keras(
        tmp_path / "pos.keras",
        [
            ("Conv1D", {"filters": 6, "kernel_size": [5], **conv}),
            ("Conv1D", {"filters": 4, "kernel_size": [3], **conv}),
            ("Flatten", {}),
            ("Dense", {"units": 5, "activation": "relu"}),
            ("Dense", {"units": 1, "activation": "linear"}),
        ],
        2,
        pos,
    )
    write_keras(
        tmp_path / "force.keras",
        [
            lstm_layer(6, True),
            lstm_layer(3, False),
            ("Dense", {"units": 5, "activation": "relu"}),
            ("Dropout", {"rate": 0.2}),
            ("Dense", {"units": 2, "activation": "linear"}),
        ],
        3,
        force,
    )
    (tmp_path / "scalers.json").write_text(json.dumps(SCALERS))
    return tmp_path, pos, force


def load(folder):
    return read_keras_surrogate(
        folder / "pos.keras", folder / "force.keras", folder / "scalers.json"
    )


def test_imported_weights_compute_the_same_as_plain_numpy(files):
    folder, pos, force = files
    surrogate = load(folder)
    x = np.random.default_rng(1).uniform(size=(4, 3, WINDOW)).astype(np.float32)
    for one, angle, forces in zip(
        x, surrogate.posnet(jnp.asarray(x[:, :2])), surrogate.forcenet(jnp.asarray(x)), strict=True
    ):
        h = np.maximum(convolution(one[:2], *pos["conv1d"]), 0)
        h = np.maximum(convolution(h, *pos["conv1d_1"]), 0).reshape(-1)
        h = np.maximum(h @ pos["dense"][0] + pos["dense"][1], 0)
        np.testing.assert_allclose(angle, h @ pos["dense_1"][0] + pos["dense_1"][1], atol=1e-5)
        h = lstm(lstm(one, *force["lstm/cell"]), *force["lstm_1/cell"])[-1]
        h = np.maximum(h @ force["dense"][0] + force["dense"][1], 0)
        np.testing.assert_allclose(forces, h @ force["dense_1"][0] + force["dense_1"][1], atol=1e-5)


def test_the_command_writes_a_surrogate(files, monkeypatch, capsys):
    folder, _, _ = files
    monkeypatch.chdir(folder)
    words = "import_keras pos.keras force.keras --scalers scalers.json --out published"
    monkeypatch.setattr(sys, "argv", words.split())
    main()
    surrogate = load_surrogate(folder / "published")
    assert capsys.readouterr().out == f"published: {surrogate.parameters():,} parameters\n"
    assert surrogate.limits.velocity_max == pytest.approx(1 / 0.6)
    with pytest.raises(SystemExit, match="import_keras: published: already exists"):
        main()


def test_published_networks_compute_what_keras_computed(published):
    surrogate = read_keras_surrogate(
        published / "cnn_pos_net.keras",
        published / "lstm_force_net.keras",
        published / "scalers.json",
    )
    assert surrogate.posnet.config.parameters() == 113_601
    assert surrogate.forcenet.config.parameters() == 144_258
    reference = np.load(published / "keras_reference.npz")
    np.testing.assert_allclose(
        surrogate.posnet(jnp.asarray(reference["posnet_input"])),
        reference["posnet_output"],
        atol=1e-6,
    )
    forces = surrogate.forcenet(jnp.asarray(reference["forcenet_input"]))
    np.testing.assert_allclose(forces, reference["forcenet_output"], atol=1e-6)

    series = {name: reference[name].astype(np.float32) for name in reference.files}
    measured = np.stack([series["force_x"], series["force_y"]], axis=1)
    time = np.arange(len(measured), dtype=np.float32) / 100
    log = Log(
        Command(series["command_angle"], series["command_velocity"]),
        Reading(time, series["angle"], np.zeros_like(time), measured),
    )
    np.testing.assert_allclose(surrogate.predict_angle(log), series["angle"][100:], atol=1e-5)
    np.testing.assert_allclose(
        surrogate.predict_force(log, free_running=True), measured[100:], atol=1e-4
    )


def rewrite(path, name, data):
    with zipfile.ZipFile(path) as archive:
        content = {entry: archive.read(entry) for entry in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, old in content.items():
            archive.writestr(entry, data if entry == name else old)


def with_first_weights(path, shape):
    with zipfile.ZipFile(path) as archive:
        content = io.BytesIO(archive.read("model.weights.h5"))
    with h5py.File(content, "r+") as file:
        del file[FIRST]
        if shape is not None:
            file[FIRST] = np.zeros(shape)
    rewrite(path, "model.weights.h5", content.getvalue())


STRIDED = {"name": "c", "filters": 2, "kernel_size": [3], "strides": [2], "activation": "relu"}


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda path: path.write_bytes(path.read_bytes()[:-200]), "invalid or incomplete Keras 2"),
        (lambda path: rewrite(path, "model.weights.h5", b"no HDF5"), "cannot be read"),
        (lambda path: rewrite(path, "config.json", b"[" * 100_000), "invalid or incomplete"),
        (lambda path: rewrite(path, "config.json", b"{}"), "only Sequential models"),
        (lambda path: with_first_weights(path, None), "object '0' doesn't exist"),
        (lambda path: with_first_weights(path, (5, 3)), "0.kernel has the shape"),
        (lambda path: write_keras(path, [("GRU", {})], 2, {}), "unsupported layer GRU"),
        (lambda path: write_keras(path, [("Conv1D", STRIDED)], 2, {}), "layer c: strides ="),
        (lambda path: write_keras(path, [], 3, {}), "has 3 input channels; expected 2"),
    ],
)
def test_a_damaged_or_unsupported_file_is_one_line(files, damage, words):
    path = files[0] / "pos.keras"
    damage(path)
    with pytest.raises(SoftfinError, match=words) as error:
        load(files[0])
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop("force_y_n"), "missing scaling for force_y_n"),
        (lambda s: s["angle_rad"].update(scale=-1), "angle_rad.scale = -1"),
        (lambda s: s["command_angle_rad"].update(data_max=100.0), "limits: angle_max_rad is 100"),
    ],
)
def test_scalers_that_do_not_fit_are_refused(files, change, words):
    scalers = json.loads(json.dumps(SCALERS))
    change(scalers)
    (files[0] / "scalers.json").write_text(json.dumps(scalers))
    with pytest.raises(SoftfinError, match=words):
        load(files[0])


def test_pickled_scalers_are_refused_unread(files):
    (files[0] / "scalers.json").write_bytes(b"\x80\x04\x95")
    with pytest.raises(ArtifactError, match="softfin does not read pickles"):
        load(files[0])
