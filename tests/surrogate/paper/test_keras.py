import io
import json
import zipfile

import h5py
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ArtifactError, SoftfinError
from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate import read_keras_surrogate
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


def test_imported_weights_say_what_plain_numpy_says(files):
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


def test_scalers_turn_units_into_what_the_nets_see(files):
    surrogate = load(files[0])
    assert surrogate.scaling.scaled("angle_rad", np.ones(1)) == pytest.approx(0.81)
    assert surrogate.limits.velocity_max == pytest.approx(1 / 0.6)
    np.testing.assert_allclose(
        surrogate.scaling.physical(["force_x_n"], jnp.asarray([[0.4]])), 0.0, atol=1e-5
    )


def rewrite(path, name, data):
    with zipfile.ZipFile(path) as archive:
        content = {entry: archive.read(entry) for entry in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, old in content.items():
            archive.writestr(entry, data if entry == name else old)


def test_a_truncated_file_is_refused_by_name(files):
    path = files[0] / "pos.keras"
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(
        ArtifactError, match=r"pos\.keras: invalid or incomplete Keras 2 \.keras file"
    ):
        load(files[0])


def test_damaged_weights_are_refused_by_name(files):
    rewrite(files[0] / "force.keras", "model.weights.h5", b"no HDF5")
    with pytest.raises(ArtifactError, match=r"force\.keras: "):
        load(files[0])


def test_nets_in_the_wrong_order_are_told_apart(files):
    with pytest.raises(
        ArtifactError,
        match="has 3 input channels; expected 2: command_angle_rad, command_velo",
    ):
        read_keras_surrogate(
            files[0] / "force.keras", files[0] / "pos.keras", files[0] / "scalers.json"
        )


def test_an_unknown_layer_is_named(files):
    write_keras(files[0] / "pos.keras", [("GRU", {"units": 3})], 2, {})
    with pytest.raises(ArtifactError, match="unsupported layer GRU; supported layers are Conv1D"):
        load(files[0])


def test_a_convolution_with_stride_is_refused(files):
    layer = (
        "Conv1D",
        {
            "name": "c",
            "filters": 2,
            "kernel_size": [3],
            "padding": "same",
            "strides": [2],
            "activation": "relu",
        },
    )
    write_keras(files[0] / "pos.keras", [layer], 2, {})
    with pytest.raises(
        ArtifactError, match=r"layer c: strides = \[2\] is not supported; must be \[1\]"
    ):
        load(files[0])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda s: s.pop("force_y_n"), "missing scaling for force_y_n"),
        (
            lambda s: s["angle_rad"].update(scale=-1),
            "angle_rad.scale = -1: Input should be greater than 0",
        ),
        (lambda s: s["angle_rad"].pop("offset"), "angle_rad.offset: missing required key"),
        (
            lambda s: s["command_angle_rad"].update(data_max=100.0),
            r"scalers\.json: limits: angle_max_rad is 100",
        ),
    ],
)
def test_scalers_that_miss_something_are_refused(files, change, words):
    scalers = json.loads(json.dumps(SCALERS))
    change(scalers)
    (files[0] / "scalers.json").write_text(json.dumps(scalers))
    with pytest.raises(SoftfinError, match=words):
        load(files[0])


def test_pickled_scalers_are_refused_unread(files):
    (files[0] / "scalers.json").write_bytes(b"\x80\x04\x95")
    with pytest.raises(
        ArtifactError, match="convert the scalers to JSON; softfin does not read pickles"
    ):
        load(files[0])


def test_published_nets_say_what_keras_says(published):
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


FIRST = "layers/conv1d/vars/0"


def craft(path, change):
    """With the HDF5 of a file changed by `change`."""
    with zipfile.ZipFile(path) as archive:
        content = io.BytesIO(archive.read("model.weights.h5"))
    with h5py.File(content, "r+") as file:
        change(file)
    rewrite(path, "model.weights.h5", content.getvalue())


def of_other_shape(file):
    del file[FIRST]
    file[FIRST] = np.zeros((5, 3))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda file: file.pop(FIRST),
            r"invalid or incomplete Keras 2 \.keras file \(.*object '0' doesn't exist",
        ),
        (
            of_other_shape,
            r"0\.kernel has the shape \(5, 3\); expected a finite array of shape \(5, 10, 6\)",
        ),
    ],
)
def test_weights_that_are_missing_or_of_another_shape_are_named(files, change, words):
    craft(files[0] / "pos.keras", change)
    with pytest.raises(ArtifactError, match=words) as error:
        load(files[0])
    assert str(error.value).startswith(str(files[0] / "pos.keras"))


def test_a_damaged_heap_is_one_line(files):
    with zipfile.ZipFile(files[0] / "pos.keras") as archive:
        content = archive.read("model.weights.h5")
    rewrite(files[0] / "pos.keras", "model.weights.h5", content.replace(b"HEAP", b"PEAH"))
    with pytest.raises(
        ArtifactError, match=r"pos\.keras: invalid or incomplete Keras 2 \.keras file"
    ) as error:
        load(files[0])
    assert "\n" not in str(error.value)


def listing(*layers):
    return b'{"class_name": "Sequential", "config": {"layers": [' + b", ".join(layers) + b"]}}"


@pytest.mark.parametrize(
    "description",
    [
        b"[" * 100_000,
        b'{"a": ' * 200 + b"1" + b"}" * 200,
        b"[]",
        listing(
            b'{"class_name": "InputLayer", "config": {"batch_input_shape": [null, 1e999, 10]}}'
        ),
        listing(b'{"class_name": "Flatten", "config": {}}', b"{}"),
        listing(
            b'{"class_name": "Dense", "config": {"activation": "relu", "units": 1'
            + b"0" * 4000
            + b"}}"
        ),
    ],
)
def test_a_description_that_is_no_nets_is_one_line(files, description):
    rewrite(files[0] / "pos.keras", "config.json", description)
    with pytest.raises(SoftfinError, match=r"pos\.keras: ") as error:
        load(files[0])
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


def test_scalers_of_many_levels_are_one_line(files):
    (files[0] / "scalers.json").write_text("[" * 100_000)
    with pytest.raises(ArtifactError, match=r"scalers\.json: invalid JSON"):
        load(files[0])
