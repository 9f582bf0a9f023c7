"""Identity of plants: `identity` identifies a plant in files, `jit_argument` turns it into an
argument of compiled programs.

softfin's own plants are pytrees of arrays and plain values, which are compared directly. A user's
simulator can only be compared by its computation: a gain may be an attribute, a constant of its
module, a closure or a file. Its `init` and `advance` are therefore traced and lowered, which takes
milliseconds, and the programs are compared.
"""

import hashlib
import operator
import re
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray, PyTree

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import PlantError, one_line
from softfin.core.plant import EnsemblePlant, Plant, TrueForcePlant
from softfin.core.quantities import Command, Limits

PLAIN = (bool, int, float, str, type(None))
"""Types of leaves that their text describes completely."""

CALLBACK = re.compile(r"custom_call @\w*python\w*callback")
"""Pattern of a Python callback in a lowered program. The program does not contain what the callback
does."""


def identity(plant: Plant, computed: bool = False) -> str:
    """Return the type of a plant and a hash of what it computes: equal for equal plants in every
    process.

    For softfin's own plants, the hash covers what was loaded; with `computed`, it also covers what
    XLA computed from that, whose last bits depend on XLA's options. Resumed runs compare the
    latter. For a user's simulator, the hash also depends
    on the version of JAX, which generates the lowered program, so the version is part of the text.
    A simulator may define an attribute `identity`. Otherwise it must be traceable and must not call
    back into Python; if it does, PlantError is raised.
    """
    name = f"{type(plant).__module__}.{type(plant).__qualname__}"
    stated = getattr(plant, "identity", None)
    if isinstance(stated, str):
        return f"{name} {stated}"
    arrays, static = eqx.partition(plant, eqx.is_array)
    if _is_own(plant, static):
        leaves, structure = jax.tree.flatten(static)
        # The structure's text contains the names of NamedTuples and their fields. Renaming one
        # changes the identity of every surrogate, so that no unfinished run matches.
        for each in () if computed else getattr(plant, "computed", ()):
            arrays = eqx.tree_at(operator.attrgetter(each), arrays, None)
        return f"{name} {_digest(arrays, str(leaves if leaves else '') + str(structure))}"
    program = _program(plant, arrays, static)
    if CALLBACK.search(program):
        raise PlantError(
            f"plant {name}: calls back into Python, so its program does not contain its "
            "parameters; add an attribute `identity`, a string that contains them"
        )
    return f"{name} {_digest(arrays, program)} (jax {jax.__version__})"


def jit_argument(plant: Plant) -> Plant:
    """Return the plant as a pytree whose arrays are traced, and whose compiled program is reused
    only for equal plants.

    For use with `equinox.filter_jit`. A user's simulator is traced on each call of this function: a
    compiled program contains the simulator as it was then, and is reused only while the simulator
    computes the same.
    """
    arrays, static = eqx.partition(plant, eqx.is_array)
    if _is_own(plant, static):
        return plant
    program = _program(plant, arrays, static)
    # Equal programs with Python callbacks may still call different objects, so compare by object.
    key = (_digest(None, program), id(static) if CALLBACK.search(program) else None)
    kind: Any = TracedPlant
    if isinstance(plant, EnsemblePlant):
        kind = TracedEnsemble
    elif isinstance(plant, TrueForcePlant):
        kind = TracedTrueForcePlant
    traced: Plant = kind(arrays, _Program(static, key))
    return traced


@dataclass(frozen=True)
class _Program:
    """The static part of a plant, compiled into programs; equal if the programs are equal."""

    static: PyTree = field(compare=False)
    key: tuple[str, int | None]


def _of_simulator(name: str) -> Any:
    return property(
        lambda traced: getattr(eqx.combine(traced.arrays, traced.program.static), name, None)
    )


class TracedPlant(eqx.Module):
    """Meets the Plant contract: a user's simulator as an argument of compiled programs."""

    arrays: PyTree
    program: _Program = eqx.field(static=True)

    init, advance, hold_action = map(_of_simulator, ("init", "advance", "hold_action"))

    @property
    def limits(self) -> Limits:
        """Limits of the simulator's commands."""
        return Limits(*eqx.combine(self.arrays, self.program.static).limits)


class TracedTrueForcePlant(TracedPlant):
    """Meets the TrueForcePlant contract: a user's simulator of a fin and its sensor."""

    true_force = _of_simulator("true_force")


class TracedEnsemble(TracedPlant):
    """Meets the EnsemblePlant contract: a user's ensemble as an argument of compiled programs."""

    size, interval, member = map(_of_simulator, ("size", "interval", "member"))
    advance_members, distance = map(_of_simulator, ("advance_members", "distance"))


def _is_own(plant: Plant, static: PyTree) -> bool:
    module = type(plant).__module__
    return module.startswith("softfin.") and all(
        isinstance(leaf, PLAIN) for leaf in jax.tree.leaves(static)
    )


def _program(plant: Plant, arrays: PyTree, static: PyTree) -> str:
    """Return everything that a plant computes, as the text of a lowered program. Its arrays are
    arguments; other constants are part of the program.

    The program is lowered for a fixed platform, so that the text is the same on every machine.
    """

    def everything(arrays: PyTree, key: PRNGKeyArray, command: Command) -> Any:
        whole: Plant = eqx.combine(arrays, static)
        state = whole.init(key)
        own = getattr(whole, "hold_action", None)
        ticks = PAPER_CLOCK.ticks[0]
        rows = PAPER_CLOCK.max_ticks
        held = [] if own is None else [own(state, command, jnp.int32(ticks), rows)]
        if isinstance(whole, EnsemblePlant):
            member = whole.member(jnp.int32(0))
            held += [
                whole.advance_members(state, command, 1),
                whole.distance(state),
                member.advance(member.init(key), command, 1),
            ]
        if isinstance(whole, TrueForcePlant):
            held.append(whole.true_force(state))
        return [whole.advance(state, command, count) for count in (1, ticks)] + held

    try:
        limits = [float(limit) for limit in plant.limits]
        command = Command(jnp.float32(0), jnp.float32(limits[2]))
        traced = jax.jit(everything).trace(arrays, jax.random.key(0), command)
        return f"{limits} {traced.lower(lowering_platforms=('cpu',)).as_text()}"
    except Exception as error:
        # The user's code runs here and may raise any error.
        reason = one_line(error)
        raise PlantError(
            f"plant {type(plant).__qualname__}: cannot be traced ({type(error).__name__}: "
            f"{reason}); run softfin.testing.check_plant to find out what is wrong"
        ) from error


def _digest(arrays: PyTree, text: str) -> str:
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(arrays):
        # Only the bytes: a simulator's program contains types and shapes, and for softfin's own
        # plants they follow from the class.
        is_key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
        digest.update(np.asarray(jax.random.key_data(leaf) if is_key else leaf).tobytes())
    digest.update(text.encode())
    # 64 bits: collisions among a user's few plants are practically impossible.
    return digest.hexdigest()[:16]
