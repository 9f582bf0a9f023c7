"""Arrays out of the HDF5 of a ``.keras`` file, as Keras writes them: groups, and in them plain blocks of numbers.

HDF5 can do far more: it follows links into other files, takes the numbers from anywhere on the disk, inflates, and
runs filters out of libraries. None of that is followed. What stands in the file is compared with what the net needs
before a number is read.
"""

import io
import math
from collections.abc import Mapping

import h5py
import numpy as np

from softfin.core.errors import ArtifactError

Shape = tuple[int, ...]


def read_arrays(content: bytes, shapes: Mapping[str, Shape], source: str) -> dict[str, np.ndarray]:
    """The arrays at these places, as float32; raises ArtifactError where one is missing, or not a plain array."""
    try:
        with h5py.File(io.BytesIO(content), "r") as file:
            places = {place: _found(file.id, place, shape, source) for place, shape in shapes.items()}
            taken = sum(place.get_storage_size() for place in places.values())
            if taken > len(content):
                raise ArtifactError(f"{source}: {taken:,} bytes of weights in {len(content):,} bytes; copy it again")
            return {name: _read(place, shapes[name]) for name, place in places.items()}
    except ArtifactError:
        raise
    except Exception as error:
        # Damaged files fail anywhere in HDF5, and h5py makes of it whatever exception it holds for fitting.
        reason = " ".join(str(error).split())[:300] or type(error).__name__
        raise ArtifactError(f"{source}: its weights are damaged ({reason}); copy it again") from None


def _found(file: h5py.h5f.FileID, place: str, shape: Shape, source: str) -> h5py.h5d.DatasetID:
    at = h5py.h5o.open(file, b"/")
    for part in place.encode().split(b"/"):
        if not isinstance(at, h5py.h5g.GroupID) or not at.links.exists(part):
            raise ArtifactError(f"{source}: weights {place} are missing; the file is not whole")
        if at.links.get_info(part).type != h5py.h5l.TYPE_HARD:
            raise ArtifactError(f"{source}: weights {place}: a link to elsewhere, which is not followed; save it again")
        at = h5py.h5o.open(at, part)
    if not isinstance(at, h5py.h5d.DatasetID):
        raise ArtifactError(f"{source}: weights {place}: a group, not an array; the file is not whole")
    if at.shape != shape:
        raise ArtifactError(f"{source}: weights {place} have shape {at.shape}; its layers need {shape}")
    if at.dtype.kind != "f":
        raise ArtifactError(f"{source}: weights {place} are of type {at.dtype}; they must be floating-point numbers")
    plan = at.get_create_plist()
    if plan.get_layout() not in (h5py.h5d.CONTIGUOUS, h5py.h5d.COMPACT) or plan.get_nfilters():
        raise ArtifactError(f"{source}: weights {place} are in pieces, virtual or compressed; Keras writes plain ones")
    if plan.get_external_count():
        raise ArtifactError(f"{source}: weights {place} lie in another file, which is not read; save it again")
    if at.get_storage_size() != math.prod(shape) * at.dtype.itemsize:
        raise ArtifactError(f"{source}: weights {place} were never written; save it again")
    return at


def _read(place: h5py.h5d.DatasetID, shape: Shape) -> np.ndarray:
    values = np.empty(shape, np.float32)
    place.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
    return values
