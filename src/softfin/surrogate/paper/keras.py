"""Import of Keras 2 ``.keras`` files: a zip with the layers as JSON and the weights as HDF5. No TensorFlow, no pickle.

The scaler values come as a JSON file of ``{channel: {scale, offset, data_min, data_max}}``. HDF5 can do far more than
Keras writes: it follows links into other files, takes the numbers from anywhere on the disk, inflates, and runs filters
out of libraries. None of that is followed; what stands in the file is compared with what the net needs before a number
is read.
"""

import io
import json
import math
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

LARGEST_JSON = 2**20
LARGEST_FILE = 32 * 2**20
"""Bytes, also of the weights in it; the published nets have 1.8 million, the description of their layers 5 thousand."""

MOST_LAYERS = 100

_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, LookupError, TypeError, AttributeError, ValueError,
            ArithmeticError)  # fmt: skip
"""What `zipfile` raises, encryption among it, and what a description raises that has other entries than Keras's."""


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
            description = json.loads(_member(archive, "config.json", LARGEST_JSON))
            weights = _member(archive, "model.weights.h5", LARGEST_FILE)
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


def _member(archive: zipfile.ZipFile, name: str, largest: int) -> bytes:
    """Read one file of the archive, as Keras packs it; raises ValueError where it would inflate beyond `largest`."""
    entry = archive.getinfo(name)
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is packed in a way that Keras does not use")
    if entry.file_size > largest:
        raise ValueError(f"{name} inflates to {entry.file_size:,} bytes, over {largest:,}")
    with archive.open(entry) as file:
        # The size that stands in the archive may be wrong.
        content = file.read(largest + 1)
    if len(content) != entry.file_size:
        raise ValueError(f"{name} has {len(content):,} bytes, and should have {entry.file_size:,}")
    return content


def _layers(path: Path, description: dict[str, Any]) -> tuple[list[Layer], list[str], tuple[int, int]]:
    """The layers, the HDF5 group of each (numbered within its class, as Keras 2.15 saves them), the input's shape."""
    if description.get("class_name") != "Sequential":
        raise ArtifactError(f"{path}: is a {description.get('class_name')} model; only Sequential ones can be imported")
    layers: list[Layer] = []
    groups: list[str] = []
    counts: dict[str, int] = {}
    shape = (0, 0)
    listed = description["config"]["layers"]
    if len(listed) > MOST_LAYERS:
        raise ArtifactError(f"{path}: has {len(listed):,} layers; at most {MOST_LAYERS} are taken")
    for entry in listed:
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
    """Read the arrays at these places as float32; raises ArtifactError where one is missing, or not a plain array."""
    arrays = dict[str, np.ndarray]()
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            found = {name: _dataset(file.id, place, shape, source) for name, (place, shape) in places.items()}
            size = sum(dataset.get_storage_size() for dataset in found.values())
            if size > len(content):
                raise ArtifactError(f"{source}: {size:,} bytes of weights in {len(content):,} bytes; copy it again")
            for name, dataset in found.items():
                arrays[name] = np.empty(places[name][1], np.float32)
                dataset.read(h5py.h5s.ALL, h5py.h5s.ALL, arrays[name])
    except ArtifactError:
        raise
    except Exception as error:
        # Damaged files fail anywhere in HDF5, and h5py makes of it whatever exception it holds for fitting.
        raise ArtifactError(f"{source}: its weights are damaged ({_short(error)}); copy it again") from None
    return arrays


def _dataset(file: h5py.h5f.FileID, place: str, shape: Shape, source: str) -> h5py.h5d.DatasetID:
    """Open an array that lies whole and plain in the file; raises ArtifactError for anything else."""
    at = h5py.h5o.open(file, b"/")
    for part in place.encode().split(b"/"):
        if not isinstance(at, h5py.h5g.GroupID) or not at.links.exists(part):
            raise ArtifactError(f"{source}: weights {place} are missing; the file is not whole")
        if at.links.get_info(part).type != h5py.h5l.TYPE_HARD:
            raise ArtifactError(f"{source}: weights {place}: a link to elsewhere, which is not followed; save it again")
        at = h5py.h5o.open(at, part)
    if not isinstance(at, h5py.h5d.DatasetID) or at.shape != shape or at.dtype.kind != "f":
        kind = f"{at.dtype} {at.shape}" if isinstance(at, h5py.h5d.DatasetID) else "a group"
        raise ArtifactError(f"{source}: weights {place} are {kind}; the layers need floating-point numbers of {shape}")
    plan, size = at.get_create_plist(), math.prod(shape) * at.dtype.itemsize
    plain = plan.get_layout() in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT) and not plan.get_nfilters()
    if not plain or plan.get_external_count() or at.get_storage_size() != size:
        raise ArtifactError(f"{source}: weights {place} are not one plain block in this file, as Keras writes it; save "
                            "it again")  # fmt: skip
    return at


def _short(error: Exception) -> str:
    return " ".join(str(error).split())[:300] or type(error).__name__
