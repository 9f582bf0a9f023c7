"""Identity of a plant: its type and a hash of its fields, which distinguish plants in files and
resumed runs.

A plant must be a pytree, such as an `equinox.Module`. Compiled programs then take its arrays as
arguments and are recompiled if any other field changes. A simulator that is not a pytree, or that
depends on more than its fields, has an attribute `identity`.
"""

import dataclasses
import functools
import hashlib
import sys
from collections.abc import Iterable, Iterator, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from pydantic import BaseModel

from softfin.core.errors import PlantError
from softfin.core.plant import Plant

PLAIN = (bool, int, float, complex, str, bytes, type(None))
"""Types whose values are completely described by their text."""

STATE_IDENTITY = "add an attribute `identity`, a string that contains all parameters"


def identity(plant: Plant) -> str:
    """Return the type of a plant and a hash of its limits and fields: equal for equal plants in
    every process.

    The hash excludes the fields in the class attribute `computed`: XLA computed them from other
    fields, and their last bits depend on the processor. It also excludes the fields in `optional`
    that are None: they were added later, and identities are stored in files. Raises PlantError if
    the plant is not a pytree and has no attribute `identity`.
    """
    name = f"{type(plant).__module__}.{type(plant).__qualname__}"
    stated = getattr(plant, "identity", None)
    is_pytree = not jax.tree_util.all_leaves([plant])
    # Compiled programs look up a plant that is not a pytree by its hash.
    if not is_pytree and (stated is None or type(plant).__hash__ is None):
        raise PlantError(
            f"plant {name}: not a pytree; make it an equinox.Module, or make it hashable and "
            f"{STATE_IDENTITY}"
        )
    if isinstance(stated, str):
        return f"{name} {stated}"
    limits = tuple(map(float, plant.limits))
    digest = hashlib.sha256()
    for part in _parts((limits, plant), "fields", name):
        digest.update(part)
    # 64 bits: collisions among a user's few plants are practically impossible.
    return f"{name} {digest.hexdigest()[:16]}"


def _parts(value: object, place: str, plant: str) -> Iterator[bytes]:
    """Yield the place, type and content of a value or of each of its members."""
    if isinstance(value, jax.Array | np.ndarray | np.generic):
        if isinstance(value, jax.Array) and jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            value = jax.random.key_data(value)
        array = np.asarray(value)
        # The type is left out: JAX and NumPy arrays with the same values are the same parameter.
        yield f"{place}: {array.dtype} {array.shape} ".encode()
        yield array.tobytes()
        return
    yield f"{place}: {type(value).__qualname__} ".encode()
    name = _find_name(value)
    if isinstance(value, PLAIN):
        yield repr(value).encode()
    elif name is not None:
        yield f"{value.__module__}.{name}".encode()
    else:
        for part, member in _members(value, place, plant):
            yield from _parts(member, f"{place}.{part}", plant)


def _find_name(value: object) -> str | None:
    """Return the name of a function or class in its module; None for anything else. A closure, a
    bound method and a partial function depend on more than their names."""
    found: object = sys.modules.get(getattr(value, "__module__", None) or "")
    name: str = getattr(value, "__qualname__", "")
    for part in name.split("."):
        found = getattr(found, part, None)
    return name if found is value else None


def _members(value: object, place: str, plant: str) -> Iterable[tuple[object, object]]:
    """Return the names and values of the members of a container, dataclass or bound method."""
    if isinstance(value, Mapping):
        return sorted(value.items())
    if isinstance(value, BaseModel):
        return iter(value)
    if isinstance(value, tuple | list):
        return enumerate(value)
    if hasattr(value, "__self__"):
        # A method of a built-in type has no function.
        function = getattr(value, "__func__", getattr(value, "__name__", None))
        return [("function", function), ("owner", value.__self__)]
    if isinstance(value, functools.partial):
        return [("function", value.func), ("arguments", value.args), ("options", value.keywords)]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        computed = getattr(value, "computed", ())
        optional = getattr(value, "optional", ())
        names = [field.name for field in dataclasses.fields(value) if field.name not in computed]
        members = [(name, getattr(value, name)) for name in names]
        return [each for each in members if each[0] not in optional or each[1] is not None]
    raise PlantError(
        f"plant {plant}: {place} is a {type(value).__qualname__}, which cannot be compared; make "
        f"it an equinox.Module, or {STATE_IDENTITY}"
    )
