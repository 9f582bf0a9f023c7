"""Import of Keras 2 ``.keras`` files: a zip with the layers as JSON and the weights as HDF5. No TensorFlow, no pickle.

The scaler values come as a JSON file of ``{channel: {scale, offset, data_min, data_max}}``.
"""

import io
import json
import reprlib
import zipfile
import zlib
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pydantic

from softfin.core.errors import ArtifactError
from softfin.surrogate.channels import ANGLE, COMMANDS, FORCES, Scaling
from softfin.surrogate.paper.layers import LSTM, Conv1D, Dense, Dropout, Flatten, Layer, MeanPool, Shape
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.paper.surrogate import Surrogate

WEIGHT_NAMES = {"conv1d": ("kernel", "bias"), "dense": ("kernel", "bias"), "lstm": ("kernel", "recurrent", "bias")}
"""Names of Keras's ``vars/0``, ``vars/1``, ... in their order."""

LARGEST = 32 * 2**20
"""Bytes of a file, and of each part of it; the published nets have 1.8 million."""

_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, LookupError, TypeError, AttributeError, ValueError,
            ArithmeticError)  # fmt: skip
"""What `zipfile` raises, and what a description raises that has other entries than Keras's."""


def import_keras(posnet: Path, forcenet: Path, scalers: Path) -> Surrogate:
    """Read a surrogate from two ``.keras`` files and the scalers' JSON; raises ArtifactError where it cannot."""
    scaling = read_scalers(scalers)
    scaling.require(str(scalers))
    nets = read_network(posnet, COMMANDS, (ANGLE,)), read_network(forcenet, (ANGLE, *COMMANDS), FORCES)
    surrogate = Surrogate(*nets, scaling)
    if problem := surrogate.limits.problem():
        raise ArtifactError(f"{scalers}: {problem}; they are data_min and data_max of the commands' channels")
    return surrogate


def read_scalers(path: Path) -> Scaling:
    """Read the scaling of each channel."""
    try:
        return Scaling(channels=json.loads(path.read_bytes()))
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror or error})") from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"][1:])) or "scalers"
        raise ArtifactError(f"{path}: {where}: {first['msg']}") from None
    except (ValueError, RecursionError) as error:
        raise ArtifactError(f"{path}: not JSON ({error}); give the scalers as JSON, never as pickle") from None


def read_network(path: Path, channels: tuple[str, ...], outputs: tuple[str, ...]) -> Network:
    """Read one ``.keras`` file as a network."""
    try:
        with zipfile.ZipFile(path) as archive:
            if max(entry.file_size for entry in archive.infolist()) > LARGEST:
                raise ValueError(f"a part of it inflates to more than {LARGEST:,} bytes")
            description = json.loads(archive.read("config.json"))
            weights = archive.read("model.weights.h5")
        layers, groups, shape = _layers(path, description)
        if shape[0] != len(channels):
            raise ArtifactError(
                f"{path}: takes {shape[0]} channels; this net must take {len(channels)}: {', '.join(channels)}"
            )
        config = NetworkConfig(channels=channels, outputs=outputs, window=shape[1], layers=tuple(layers))
        if config.examples()[-1] != (len(outputs),):
            raise ArtifactError(
                f"{path}: gives {config.examples()[-1]} values; this net must give {', '.join(outputs)}"
            )
        places = _places(config, groups)
    except OSError as error:
        raise ArtifactError(f"{path}: cannot be read ({error.strerror or error})") from None
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        raise ArtifactError(f"{path}: a layer's {where} = {reprlib.repr(first['input'])}: {first['msg']}") from None
    except _DAMAGED as error:
        raise ArtifactError(f"{path}: not a whole Keras 2 .keras file ({_short(error)})") from None
    return Network.of(config, _read_arrays(weights, places, str(path)), str(path))


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


def _places(config: NetworkConfig, groups: list[str]) -> dict[str, tuple[str, Shape]]:
    """Place in the HDF5 and shape of each weight by its name."""
    return {
        f"{index}.{name}": (f"{group}/{'cell/vars' if layer.kind == 'lstm' else 'vars'}/{number}", shapes[name])
        for index, (layer, group, shapes) in enumerate(zip(config.layers, groups, config.shapes(), strict=True))
        for number, name in enumerate(WEIGHT_NAMES.get(layer.kind, ()))
    }


def _read_arrays(content: bytes, places: dict[str, tuple[str, Shape]], source: str) -> dict[str, np.ndarray]:
    """Read the arrays at these places as float32; raises ArtifactError where one is missing or of another shape."""
    arrays = dict[str, np.ndarray]()
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            for name, (place, shape) in places.items():
                if (found := file.get(place)) is None or getattr(found, "shape", None) != shape:
                    what = "missing" if found is None else f"of the shape {getattr(found, 'shape', None)}"
                    raise ArtifactError(f"{source}: weights {place} are {what}, must be {shape}; save it again")
                arrays[name] = np.asarray(found, np.float32)
    except ArtifactError:
        raise
    except Exception as error:
        # Damaged files fail anywhere in HDF5, and h5py makes of it whatever exception it holds for fitting.
        raise ArtifactError(f"{source}: its weights are damaged ({_short(error)}); copy it again") from None
    return arrays


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
