"""Checks of a plant and of a surrogate against their contracts."""

import itertools
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import ConfigurationError, LogError, PlantError, SoftfinError
from softfin.core.plant import EnsemblePlant, Plant, State, TrueForcePlant, roll
from softfin.core.plant_identity import identity
from softfin.core.quantities import TICK_S, Command, Limits, Log, Reading, action_to_command
from softfin.data.excitation import ExcitationConfig
from softfin.surrogate.channels import ANGLE, FORCES, SKIPPED
from softfin.surrogate.protocol import SurrogatePlant
from softfin.surrogate.registry import find_architecture
from softfin.surrogate.store import load_surrogate, save_surrogate

STROKE_TICKS = PAPER_CLOCK.ticks[0]


def check_plant(plant: Any) -> None:
    """Check that a plant meets its contract.

    Checks the members, limits, shapes, types and time, and that readings are finite at the corners
    of the limits. Also checks that the same state and command produce the same readings (purity),
    that the plant has an identity (`softfin.core.plant_identity`), that holding a command equals
    single ticks, and that `jit`, `vmap`, `scan` and `grad` work. An optional `hold_action` must do
    the same as `advance`, and an optional `true_force` must be finite and traceable.

    Args:
        plant: The plant.

    Raises:
        PlantError: If the contract is not met; the message names the problem and the
            requirement.

    Example:
        >>> check_plant(softfin.find_plant("tank"))
    """
    for check in (_members, _purity, _batches, _true_force, _strokes, _gradient, _held_action):
        check(plant)


def check_surrogate(surrogate: Any) -> None:
    """Check that a surrogate meets the contract `softfin.surrogate.protocol.SurrogatePlant`.

    Checks everything that `check_plant` checks. Also checks that the architecture is found by its
    name, that the surrogate is the same after saving and loading, that `warm` continues a history,
    and that each network of Table I predicts a log. If the surrogate is an `EnsemblePlant`, its
    readings must be the mean over its members, with a finite distance. The
    histories and logs are the surrogate's own readings under random commands.

    Args:
        surrogate: The surrogate.

    Raises:
        PlantError: If the contract is not met; the message names the problem and the
            requirement.

    Example:
        >>> check_surrogate(softfin.load_surrogate("surrogate"))
    """
    check_plant(surrogate)
    _surrogate_members(surrogate)
    _storage(surrogate)
    log = _own_log(surrogate)
    _warm_up(surrogate, log)
    _predictions(surrogate, log)
    _ensemble(surrogate)


def _fail(plant: object, *problem: str) -> NoReturn:
    """Raise PlantError with the problem and the requirement."""
    raise PlantError(f"{type(plant).__name__}: {'; '.join(problem)}")


def _stroke(plant: Plant) -> Command:
    """Return a command within the limits that moves the plant halfway from rest to the farther
    limit."""
    limits = Limits(*plant.limits)
    rest = limits.rest_angle
    furthest = max(limits.angle_max, limits.angle_min, key=lambda angle: abs(angle - rest))
    return Command(jnp.float32((rest + furthest) / 2), jnp.float32(limits.velocity_max))


def _corners(plant: Plant) -> Iterator[Command]:
    """Yield the commands at the corners of the limits."""
    limits = np.asarray(plant.limits, np.float32)
    for angle, velocity in itertools.product(limits[:2], limits[2:]):
        yield Command(jnp.asarray(angle), jnp.asarray(velocity))


def _members(plant: Any) -> None:
    if missing := [name for name in ("limits", "init", "advance") if not hasattr(plant, name)]:
        _fail(
            plant,
            f"has no {', '.join(missing)}",
            "a plant must have limits, init(key) and advance(state, command, ticks)",
        )
    try:
        limits = Limits(*(float(value) for value in plant.limits))
    except (TypeError, ValueError):
        _fail(plant, f"limits = {plant.limits!r}", "it must be a softfin.Limits of four numbers")
    if problem := limits.problem():
        _fail(plant, problem)


def _array(plant: Plant, name: str, values: Array, shape: tuple[int, ...]) -> None:
    if values.shape != shape:
        _fail(plant, f"{name} has shape {values.shape}", f"it must be {shape}")
    if values.dtype != jnp.float32:
        _fail(plant, f"{name} is {values.dtype}", "it must be float32")


def _purity(plant: Plant) -> None:
    """Check that equal inputs produce equal outputs; nothing is compiled here, because that would
    hide data that a plant keeps outside its state."""
    command = _stroke(plant)
    state = plant.init(jax.random.key(0))
    results = [plant.advance(state, command, STROKE_TICKS) for _ in range(2)]
    if not all(isinstance(result, tuple) and isinstance(result[-1], Reading) for result in results):
        _fail(plant, "advance does not return a Reading", "it must return (state, softfin.Reading)")
    if str(jax.tree.structure(results[0][0])) != str(jax.tree.structure(state)):
        _fail(
            plant,
            "advance changes the structure of the state",
            "init and advance must return the same structure",
        )
    first, second = (reading for _, reading in results)
    for name, values in first._asdict().items():
        shape = (STROKE_TICKS, 2) if name == "force" else (STROKE_TICKS,)
        _array(plant, f"reading.{name} for {STROKE_TICKS} ticks", jnp.asarray(values), shape)
    if not all(np.array_equal(a, b) for a, b in zip(first, second, strict=True)):
        asked = "a plant must keep everything, including random keys, in its state"
        _fail(plant, "the same state and command produce different readings when repeated", asked)
    if not np.allclose(first.time, TICK_S * np.arange(1, STROKE_TICKS + 1), atol=TICK_S / 4):
        _fail(
            plant,
            f"time is {np.asarray(first.time)[:3]} ...",
            "each tick must be 0.01 s, and time must start at 0",
        )


def _batches(plant: Plant) -> None:
    keys = jax.random.split(jax.random.key(1), 2)
    actions = jnp.asarray([[0.5, -0.5, 0.2], [-0.5, 0.5, 0.0]], jnp.float32)
    angles = action_to_command(plant.limits, (actions, jnp.ones_like(actions))).angle
    velocities = jnp.full_like(angles, plant.limits.velocity_max)

    def strokes(key: PRNGKeyArray, commands: Command) -> Any:
        return jax.lax.scan(
            lambda s, c: plant.advance(s, c, STROKE_TICKS), plant.init(key), commands
        )[1].force

    try:
        together = jax.jit(jax.vmap(strokes))(keys, Command(angles, velocities))
    except Exception as error:
        asked = "write init and advance in jax.numpy, with no Python branches on values"
        _fail(plant, f"jit, vmap or scan fails ({str(error).splitlines()[0]})", asked)
    # The same commands for the first fin alone, one tick at a time.
    commands = Command(*(jnp.repeat(x[0], STROKE_TICKS) for x in (angles, velocities)))
    alone = jax.jit(lambda: roll(plant, plant.init(keys[0]), commands))()[1].force.reshape(
        together[0].shape
    )
    if not np.allclose(together[0], alone, rtol=1e-2, atol=1e-2):
        asked = "advance by n ticks must equal n single ticks, with nothing shared between fins"
        _fail(
            plant,
            "a fin in a batch with held commands differs from the same fin alone, tick by tick",
            asked,
        )


def _strokes(plant: Plant) -> None:
    # Raises PlantError for a plant that cannot be compared with others.
    identity(plant)
    stroke = jax.jit(lambda state, command: plant.advance(state, command, STROKE_TICKS))
    state = plant.init(jax.random.key(0))
    for command in _corners(plant):
        state, reading = stroke(state, command)
        for name, values in reading._asdict().items():
            if not jnp.isfinite(values).all():
                _fail(
                    plant,
                    f"reading.{name} is not finite under {command}",
                    "readings must be finite within the limits",
                )


def _gradient(plant: Plant) -> None:
    def mean_force(angle: Array) -> Array:
        command = Command(angle, jnp.float32(plant.limits.velocity_max))
        return plant.advance(plant.init(jax.random.key(0)), command, STROKE_TICKS)[1].force.mean()

    # The search for gaits needs this derivative; it is NaN if a plant takes the square root of 0,
    # for example.
    slope = jax.jit(jax.grad(mean_force))(_stroke(plant).angle)
    if not jnp.isfinite(slope):
        _fail(
            plant,
            f"the gradient of the force with respect to the command is {slope}",
            "it must be finite; check for sqrt at 0",
        )


def _held_action(plant: Plant) -> None:
    own: Any = getattr(plant, "hold_action", None)
    command = _stroke(plant)
    rows = PAPER_CLOCK.max_ticks
    whole = jax.jit(lambda state, ticks: own(state, command, ticks, rows))
    for ticks in sorted(set(PAPER_CLOCK.ticks)) if own is not None else ():
        state: State = plant.init(jax.random.key(0))
        after, reading = whole(state, ticks)
        expected_after, expected = plant.advance(state, command, ticks)
        pairs = zip(
            jax.tree.leaves((after, reading.force[:ticks], reading.angle[:ticks])),
            jax.tree.leaves((expected_after, expected.force, expected.angle)),
            strict=True,
        )
        # The values of random keys cannot be compared.
        numbers = [pair for pair in pairs if not _is_key(pair[0])]
        if not all(np.allclose(one, other, rtol=1e-3, atol=1e-4) for one, other in numbers):
            asked = f"it must return {rows} rows, and the state after the first `ticks` of them"
            _fail(
                plant, f"hold_action for {ticks} ticks differs from advance by {ticks} ticks", asked
            )


def _true_force(plant: Plant) -> None:
    if not isinstance(plant, TrueForcePlant):
        return
    corners = list(_corners(plant))
    commands = Command(*map(jnp.stack, zip(*corners, strict=True)))

    def after(command: Command) -> Any:
        state, _ = plant.advance(plant.init(jax.random.key(0)), command, STROKE_TICKS)
        return plant.true_force(state)

    try:
        forces = jax.jit(jax.vmap(after))(commands)
    except Exception as error:
        asked = "write true_force(state) in jax.numpy, with no Python branches on values"
        _fail(plant, f"jit or vmap fails for true_force ({str(error).splitlines()[0]})", asked)
    if not isinstance(forces, jax.Array):
        _fail(
            plant,
            f"true_force returns a {type(forces).__name__}",
            "it must return an array of shape (2,)",
        )
    _array(plant, "true_force", forces[0], (2,))
    for command, force in zip(corners, forces, strict=True):
        if not jnp.isfinite(force).all():
            _fail(
                plant,
                f"true_force is not finite under {command}",
                "it must be finite within the limits",
            )


def _surrogate_members(surrogate: Any) -> None:
    names = [name for name in dir(SurrogatePlant) if not name.startswith("_")]
    if missing := [name for name in names if not hasattr(surrogate, name)]:
        _fail(
            surrogate,
            f"has no {', '.join(missing)}",
            "a surrogate must have all members of softfin.surrogate.protocol.SurrogatePlant",
        )
    try:
        find_architecture(surrogate.model)
    except ConfigurationError as error:
        _fail(surrogate, f"model = {surrogate.model!r}", str(error))
    count = surrogate.parameters()
    if not (isinstance(count, int) and count > 0):
        _fail(surrogate, f"parameters() is {count!r}", "it must be a positive int")
    fields = getattr(surrogate.init(jax.random.key(0)), "_fields", ("no field",))
    if fields[0] != "tick":
        _fail(
            surrogate,
            f"the state starts with {fields[0]}",
            "it must be a NamedTuple whose first field, tick, counts the samples since the start",
        )


def _storage(surrogate: SurrogatePlant) -> None:
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "surrogate"
        try:
            save_surrogate(folder, surrogate, None, {})
            loaded = load_surrogate(folder)
        except SoftfinError as error:
            _fail(
                surrogate,
                f"cannot be saved and loaded ({error})",
                "check to_files and Architecture.load",
            )
    if identity(loaded) != identity(surrogate):
        _fail(
            surrogate,
            "differs after saving and loading",
            "to_files must contain all that load needs",
        )


def _own_log(surrogate: SurrogatePlant) -> Log:
    """Return readings of the surrogate under random commands, longer than its memory."""
    rows = max(surrogate.memory, SKIPPED) + STROKE_TICKS
    commands = ExcitationConfig()(jax.random.key(0), rows + 1, surrogate.limits)
    start = surrogate.init(jax.random.key(0))
    reading = jax.jit(lambda: roll(surrogate, start, commands)[1])()
    # The command of a row acts after its reading.
    log = Log(jax.tree.map(lambda x: x[1:], commands), jax.tree.map(lambda x: x[:-1], reading))
    recorded: Log = jax.tree.map(np.asarray, log)
    return recorded


def _warm_up(surrogate: SurrogatePlant, log: Log) -> None:
    state = surrogate.warm(log)
    if _types(state) != _types(surrogate.init(jax.random.key(0))):
        _fail(
            surrogate,
            "warm and init return different states",
            "their shapes and types must be equal",
        )
    command = jax.tree.map(lambda x: x[-1], log.command)
    reading = jax.jit(lambda state: surrogate.advance(state, command, 1)[1])(state)
    if not np.allclose(reading.time, log.reading.time[-1] + TICK_S, atol=TICK_S / 4):
        _fail(
            surrogate,
            f"after a history that ends at {log.reading.time[-1]:.2f} s, the next reading is at "
            f"{float(reading.time[0]):.2f} s",
            "warm must continue the time of the history",
        )
    try:
        surrogate.warm(jax.tree.map(lambda x: x[: surrogate.memory - 1], log))
    except LogError:
        return
    _fail(
        surrogate,
        "warm accepts fewer rows than memory",
        "it must raise a softfin.core.errors.LogError",
    )


def _predictions(surrogate: SurrogatePlant, log: Log) -> None:
    for name, prediction in surrogate.predictions([log]).items():
        if not {ANGLE, *FORCES}.issuperset(prediction.channels):
            _fail(
                surrogate,
                f"predictions: {name} has the channels {', '.join(prediction.channels)}",
                f"they must be among {ANGLE}, {', '.join(FORCES)}",
            )
        shapes = [np.shape(series) for series in prediction.series]
        width = len(prediction.channels)
        if len(shapes) != 1 or shapes[0] not in [(n, width) for n in range(1, log.rows + 1)]:
            _fail(
                surrogate,
                f"predictions: {name} has series of shapes {shapes} for a log of {log.rows} rows",
                f"there must be one series (rows, {width}) per log, of its last rows",
            )


def _ensemble(surrogate: SurrogatePlant) -> None:
    if not isinstance(surrogate, EnsemblePlant):
        return
    state = surrogate.init(jax.random.key(0))
    command = _stroke(surrogate)
    after, members = surrogate.advance_members(state, command, STROKE_TICKS)
    _, mean = surrogate.advance(state, command, STROKE_TICKS)
    if not np.allclose(mean.force, members.force.mean(axis=0), rtol=1e-3, atol=1e-4):
        _fail(surrogate, "advance differs from the mean of advance_members", "they must be equal")
    distance = np.asarray(surrogate.distance(after))
    if distance.shape != () or not np.isfinite(distance):
        _fail(surrogate, f"distance is {distance}", "it must be a finite number")


def _types(state: State) -> tuple[Any, list[Any]]:
    """Return the structure of a state, and the shape and type of each leaf."""
    leaves, structure = jax.tree.flatten(state)
    return structure, [(jnp.shape(leaf), jnp.asarray(leaf).dtype) for leaf in leaves]


def _is_key(leaf: object) -> bool:
    return bool(jnp.issubdtype(jnp.asarray(leaf).dtype, jax.dtypes.prng_key))
