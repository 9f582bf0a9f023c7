"""Imports Keras 2 ``.keras`` files: a zip with the layers as JSON and the weights as HDF5. No
TensorFlow, no pickle.

The scaler values come as a JSON file of ``{channel: {scale, offset, data_min, data_max}}``.
"""

import io
import json
import zipfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from softfin.core.errors import ArtifactError, SoftfinError, one_line
from softfin.core.json_object import JsonObject
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, Scaling
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.paper.surrogate import Surrogate
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
"""Layers by their names in Keras, and the values that their options must have if given."""


def read_keras_surrogate(posnet: Path, forcenet: Path, scalers: Path) -> Surrogate:
    """Read a surrogate from two ``.keras`` files and the scalers' JSON; raises SoftfinError if it
    cannot."""
    try:
        channels = json.loads(scalers.read_bytes())
    except OSError as error:
        raise ArtifactError(f"{scalers}: cannot be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:
        raise ArtifactError(
            f"{scalers}: not JSON ({error}); give the scalers as JSON, never as pickle"
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
            f"{scalers}: {problem}; they are data_min and data_max of the commands' channels"
        )
    return surrogate


def read_network(path: Path, channels: tuple[str, ...], outputs: tuple[str, ...]) -> Network:
    """Read one ``.keras`` file as a network."""
    try:
        with zipfile.ZipFile(path) as archive:
            layers, groups, shape = _layers(path, json.loads(archive.read("config.json")))
            content = io.BytesIO(archive.read("model.weights.h5"))
        if shape[0] != len(channels):
            raise ArtifactError(
                f"{path}: takes {shape[0]} channels; this network must take {', '.join(channels)}"
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
        raise ArtifactError(f"{path}: not a whole Keras 2 .keras file ({reason})") from None


def _layers(path: Path, description: JsonObject) -> tuple[list[Any], list[str], tuple[int, int]]:
    """Return the layers, the places of their weights in the HDF5 file, and the shape of the
    input."""
    if description.get("class_name") != "Sequential":
        raise ArtifactError(
            f"{path}: is a {description.get('class_name')} model; only Sequential ones can be "
            "imported"
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
            raise ArtifactError(f"{path}: layer {kind} is not known; known are {', '.join(LAYERS)}")
        build, expected = LAYERS[kind]
        for name, value in expected.items():
            if (met := config.get(name, value)) != value:
                raise ArtifactError(
                    f"{path}: layer {config.get('name')} has {name} = {met}; it must be {value}"
                )
        layers.append(build(config))
        # Numbered within its class, as Keras 2.15 saves them.
        number = f"_{counts[kind]}" if counts[kind] else ""
        counts[kind] += 1
        groups.append(f"layers/{kind.lower()}{number}/{'cell/vars' if kind == 'LSTM' else 'vars'}")
    return layers, groups, shape
