"""Import of Keras 2 ``.keras`` files: a zip with the layers as JSON and the weights as HDF5. No TensorFlow, no pickle.

The scaler values come as a JSON file of ``{channel: {scale, offset, data_min, data_max}}``.
"""

import io
import json
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pydantic

from softfin.errors import ArtifactError
from softfin.files import regular_file
from softfin.surrogate.forcenet import FORCES
from softfin.surrogate.network import LSTM, Conv1D, Dense, Dropout, Flatten, Layer, MeanPool, Network, NetworkConfig
from softfin.surrogate.posnet import COMMANDS
from softfin.surrogate.scaling import Scaling
from softfin.surrogate.surrogate import ANGLE, Surrogate

WEIGHT_NAMES = {"conv1d": ("kernel", "bias"), "dense": ("kernel", "bias"), "lstm": ("kernel", "recurrent", "bias")}
"""Of Keras's ``vars/0``, ``vars/1``, ... in their order."""


def import_keras(posnet: Path, forcenet: Path, scalers: Path) -> Surrogate:
    """A surrogate from two ``.keras`` files and the scalers' JSON; raises ArtifactError for what it cannot take."""
    scaling = read_scalers(scalers)
    scaling.require([ANGLE, *COMMANDS, *FORCES], str(scalers))
    nets = read_network(posnet, COMMANDS, (ANGLE,)), read_network(forcenet, (ANGLE, *COMMANDS), FORCES)
    return Surrogate(*nets, scaling)


def read_scalers(path: Path) -> Scaling:
    """The scaling of each channel."""
    try:
        return Scaling(channels=json.loads(regular_file(path).read_text()))
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror})") from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        raise ArtifactError(f"{path}: {'.'.join(map(str, first['loc'][1:]))}: {first['msg']}") from None
    except ValueError as error:
        raise ArtifactError(f"{path}: not JSON ({error}); give the scalers as JSON, never as pickle") from None


def read_network(path: Path, channels: tuple[str, ...], outputs: tuple[str, ...]) -> Network:
    """One ``.keras`` file as a network."""
    try:
        with zipfile.ZipFile(regular_file(path)) as archive:
            description = json.loads(archive.read("config.json"))
            weights = archive.read("model.weights.h5")
        layers, names, shape = _layers(path, description)
        with h5py.File(io.BytesIO(weights)) as file:
            arrays = _weights(path, file, layers, names)
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror or error})") from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ArtifactError(f"{path}: a layer's {where} = {first['input']!r}: {first['msg']}") from None
    except (zipfile.BadZipFile, zlib.error, LookupError, TypeError, ValueError) as error:
        raise ArtifactError(f"{path}: not a whole Keras 2 .keras file ({error})") from None
    if shape[0] != len(channels):
        raise ArtifactError(
            f"{path}: takes {shape[0]} channels; this net must take {len(channels)}: {', '.join(channels)}"
        )
    config = NetworkConfig(channels=channels, outputs=outputs, window=shape[1], layers=tuple(layers))
    if config.examples()[-1] != (len(outputs),):
        raise ArtifactError(f"{path}: says {config.examples()[-1]} values; this net must say {', '.join(outputs)}")
    return Network.of(config, arrays, str(path))


def _layers(path: Path, description: dict[str, Any]) -> tuple[list[Layer], list[str], tuple[int, int]]:
    """The layers, the HDF5 group of each (numbered within its class, as Keras 2.15 saves them), the input's shape."""
    if description.get("class_name") != "Sequential":
        raise ArtifactError(f"{path}: is a {description.get('class_name')} model; only Sequential ones can be imported")
    layers: list[Layer] = []
    groups: list[str] = []
    counts: dict[str, int] = {}
    shape = (0, 0)
    for entry in description["config"]["layers"]:
        kind, config = entry["class_name"], entry["config"]
        batch_shape = config.get("batch_input_shape") or config.get("batch_shape")
        if batch_shape:
            shape = (int(batch_shape[1]), int(batch_shape[2]))
        if kind == "InputLayer":
            continue
        layers.append(_layer(path, kind, config))
        name = {"Conv1D": "conv1d", "LSTM": "lstm", "Dense": "dense"}.get(kind, kind)
        number = counts.get(name, 0)
        counts[name] = number + 1
        groups.append(f"layers/{name}{f'_{number}' if number else ''}")
    return layers, groups, shape


def _layer(path: Path, kind: str, config: dict[str, Any]) -> Layer:
    if kind == "Conv1D":
        _expect(path, config, padding="same", strides=[1], dilation_rate=[1], groups=1, use_bias=True,
                data_format="channels_last")  # fmt: skip
        return Conv1D(filters=config["filters"], kernel=config["kernel_size"][0], activation=config["activation"])
    if kind == "LSTM":
        _expect(path, config, activation="tanh", recurrent_activation="sigmoid", use_bias=True, go_backwards=False)
        return LSTM(units=config["units"], sequence=config["return_sequences"])
    if kind == "Dense":
        _expect(path, config, use_bias=True)
        return Dense(units=config["units"], activation=config["activation"])
    if kind == "Dropout":
        return Dropout(rate=config["rate"])
    if kind == "Flatten":
        return Flatten()
    if kind == "GlobalAveragePooling1D":
        return MeanPool()
    raise ArtifactError(f"{path}: layer {kind} is not known; known are Conv1D, LSTM, Dense, Dropout, Flatten, "
                        "GlobalAveragePooling1D")  # fmt: skip


def _expect(path: Path, config: dict[str, Any], **expected: Any) -> None:
    for name, value in expected.items():
        if config.get(name, value) != value:
            raise ArtifactError(f"{path}: layer {config.get('name')} has {name} = {config[name]}; it must be {value}")


def _weights(path: Path, file: h5py.File, layers: list[Layer], groups: list[str]) -> dict[str, np.ndarray]:
    arrays = {}
    for index, (layer, group) in enumerate(zip(layers, groups, strict=True)):
        names = WEIGHT_NAMES.get(layer.kind, ())
        inner = f"{group}/cell/vars" if layer.kind == "lstm" else f"{group}/vars"
        for number, name in enumerate(names):
            if f"{inner}/{number}" not in file:
                raise ArtifactError(f"{path}: weights {inner}/{number} are missing; the file is not whole")
            arrays[f"{index}.{name}"] = np.asarray(file[f"{inner}/{number}"])
    return arrays
