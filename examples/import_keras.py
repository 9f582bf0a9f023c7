"""Converts two Keras 2 networks and their scalers to a surrogate folder, without TensorFlow:

    python examples/import_keras.py POSNET.keras FORCENET.keras --scalers scalers.json --out published

A ``.keras`` file is a zip archive with the layers as JSON and the weights as HDF5, which are read
with the package h5py. The scalers are read from a JSON file, ``{channel: {scale, offset, data_min,
data_max}}``. Pickled scalers are not read, because loading a pickle can execute code.
"""

import argparse
import io
import json
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np

from softfin.core.errors import ArtifactError, SoftfinError, one_line
from softfin.core.json_object import JsonObject
from softfin.storage import artifact as artifacts
from softfin.surrogate import Surrogate, save_surrogate
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, Scaling
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.training import restored

LAYERS: dict[str, tuple[Callable[[JsonObject], JsonObject], JsonObject]] = {
    "Conv1D": (
        lambda c: {
            "kind": "conv1d",
            "filters": c["filters"],
            "kernel": c["kernel_size"][0],
            "activation": c["activation"],
        },
        {
            "padding": "same",
            "strides": [1],
            "dilation_rate": [1],
            "groups": 1,
            "use_bias": True,
            "data_format": "channels_last",
        },
    ),
    "LSTM": (
        lambda c: {"kind": "lstm", "units": c["units"], "sequence": c["return_sequences"]},
        {
            "activation": "tanh",
            "recurrent_activation": "sigmoid",
            "use_bias": True,
            "go_backwards": False,
        },
    ),
    "Dense": (
        lambda c: {"kind": "dense", "units": c["units"], "activation": c["activation"]},
        {"use_bias": True},
    ),
    "Dropout": (lambda c: {"kind": "dropout", "rate": c["rate"]}, {}),
    "Flatten": (lambda _: {"kind": "flatten"}, {}),
    "GlobalAveragePooling1D": (lambda _: {"kind": "mean_pool"}, {}),
}
"""Layers by Keras class name: the conversion of a layer's options, and the options for which
softfin supports only the value listed here."""


def read_keras_surrogate(posnet: Path, forcenet: Path, scalers: Path) -> Surrogate:
    """Read a surrogate from two ``.keras`` files and the scalers' JSON file.

    Raises:
        SoftfinError: a file is missing, damaged or unsupported.
    """
    try:
        channels = json.loads(scalers.read_bytes())
    except OSError as error:
        raise ArtifactError(f"{scalers}: cannot be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:
        raise ArtifactError(
            f"{scalers}: invalid JSON ({error}); convert the scalers to JSON; softfin does not "
            "read pickles"
        ) from None
    scaling = Scaling.build({"channels": channels}, str(scalers))
    scaling.require(str(scalers))
    nets = (
        read_network(posnet, COMMAND_COLUMNS, (ANGLE,)),
        read_network(forcenet, (ANGLE, *COMMAND_COLUMNS), FORCES),
    )
    surrogate = Surrogate(*nets, scaling)
    if problem := surrogate.limits.problem():
        raise ArtifactError(
            f"{scalers}: {problem}; check data_min and data_max of the command channels"
        )
    return surrogate


def read_network(path: Path, channels: tuple[str, ...], outputs: tuple[str, ...]) -> Network:
    """Read the network in a ``.keras`` file."""
    try:
        with zipfile.ZipFile(path) as archive:
            layers, groups, shape = _layers(path, json.loads(archive.read("config.json")))
            content = io.BytesIO(archive.read("model.weights.h5"))
        if shape[0] != len(channels):
            raise ArtifactError(
                f"{path}: has {shape[0]} input channels; expected {len(channels)}: "
                f"{', '.join(channels)}"
            )
        values = {"channels": channels, "outputs": outputs, "window": shape[1], "layers": layers}
        config = NetworkConfig.build(values, str(path))
        with h5py.File(content, "r") as file:
            arrays = {}
            for index, (group, shapes) in enumerate(zip(groups, config.shapes(), strict=True)):
                for number, name in enumerate(shapes):
                    weights = np.asarray(file[f"{group}/{number}"], np.float32)
                    arrays[f"{index}.{name}"] = weights
        return Network(config, restored(config.shapes(), arrays, str(path)))
    except SoftfinError:
        raise
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror or error})") from None
    except Exception as error:
        # Damaged files fail anywhere in zip, JSON and HDF5, and h5py raises many kinds of
        # exceptions.
        reason = one_line(error)
        raise ArtifactError(
            f"{path}: invalid or incomplete Keras 2 .keras file ({reason})"
        ) from None


def _layers(
    path: Path, description: JsonObject
) -> tuple[list[JsonObject], list[str], tuple[int, int]]:
    """Return the layers, the HDF5 groups of their weights, and the input shape (channels,
    samples)."""
    if description.get("class_name") != "Sequential":
        raise ArtifactError(
            f"{path}: {description.get('class_name')} model; only Sequential models can be imported"
        )
    layers = []
    groups = list[str]()
    counts = Counter[str]()
    shape = (0, 0)
    for entry in description["config"]["layers"]:
        kind = entry["class_name"]
        config = entry["config"]
        if batch_shape := config.get("batch_input_shape") or config.get("batch_shape"):
            shape = (int(batch_shape[1]), int(batch_shape[2]))
        if kind == "InputLayer":
            continue
        if kind not in LAYERS:
            raise ArtifactError(
                f"{path}: unsupported layer {kind}; supported layers are {', '.join(LAYERS)}"
            )
        build, required = LAYERS[kind]
        _check_options(path, config, required)
        layers.append(build(config))
        # Keras 2.15 numbers the layers of each class: dense, dense_1, dense_2.
        number = f"_{counts[kind]}" if counts[kind] else ""
        counts[kind] += 1
        groups.append(f"layers/{kind.lower()}{number}/{'cell/vars' if kind == 'LSTM' else 'vars'}")
    return layers, groups, shape


def _check_options(path: Path, config: JsonObject, required: JsonObject) -> None:
    for name, value in required.items():
        if (actual := config.get(name, value)) != value:
            raise ArtifactError(
                f"{path}: layer {config.get('name')}: {name} = {actual} is not supported; must be "
                f"{value}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("posnet", type=Path)
    parser.add_argument("forcenet", type=Path)
    parser.add_argument("--scalers", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--overwrite", action="store_true", help="replace an existing folder")
    words = parser.parse_args()
    try:
        surrogate = read_keras_surrogate(words.posnet, words.forcenet, words.scalers)
        sources = {name: getattr(words, name).name for name in ("posnet", "forcenet", "scalers")}
        provenance = artifacts.provenance(imported_from=sources)
        save_surrogate(words.out, surrogate, None, provenance, overwrite=words.overwrite)
    except SoftfinError as error:
        raise SystemExit(f"import_keras: {error}") from None
    print(f"{words.out}: {surrogate.parameters():,} parameters")


if __name__ == "__main__":
    main()
