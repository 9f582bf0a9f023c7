"""The emulated rigs of this process, in simulated time: made once for each rig's file, and remembered beside it.

``rig.state.json`` holds what the next command must find: where the fin stands and how the water moves, the zero of the
drive and of the sensor, and how much of the noise has been drawn. One process at a time uses a rig.
"""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any, NamedTuple

from softfin.core.errors import ConfigurationError, RigError
from softfin.core.files import read_bytes
from softfin.rig.config import RigConfig
from softfin.rig.emulation.rig import EmulatedRig
from softfin.rig.simulated_clock import SimulatedClock
from softfin.storage import artifact as artifacts
from softfin.tank import Tank, TankConfig

LARGEST_STATE = 1_000_000
"""Bytes; it has some thousand."""

_rigs: dict[Path, "Plugged"] = {}


class Plugged(NamedTuple):
    """An emulated rig as whoever drives it needs it."""

    clock: SimulatedClock
    """Made in the thread that uses the rig."""
    keep: Callable[[], None]
    """Writes down what the next command must find."""
    close: Callable[[], None]
    """Lets another process have it."""


def plugged(config: RigConfig) -> Plugged:
    """The emulated rig that a file describes, as the command before has left it; raises RigError."""
    if config.file is None:
        raise RigError("an emulated rig is described by a file that softfin rig emulate writes; load that")
    if config.file not in _rigs:
        plug(config.file, _made(config, config.file))
    return _rigs[config.file]


def plug(file: Path, rig: Plugged) -> None:
    """From now on it stands behind that file."""
    _rigs[file.resolve()] = rig


def unplug() -> None:
    """All of this process."""
    while _rigs:
        _rigs.popitem()[1].close()


def state_file(rig: Path) -> Path:
    """Beside the rig's file."""
    return rig.with_suffix(".state.json")


def _made(config: RigConfig, file: Path) -> Plugged:
    assert config.emulation is not None
    try:
        tank = Tank(TankConfig.build(config.emulation.tank, f"{file}: emulation.tank"))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
    emulation = config.emulation.model_dump(mode="json")
    lock = _locked(file)
    rig = EmulatedRig(tank, config.emulation.seed, channel=config.bus.channel)
    assert isinstance(rig.clock, SimulatedClock)

    def keep() -> None:
        state = {"emulation": emulation} | {name: part.remembered() for name, part in _parts(rig).items()}
        artifacts.write_file(state_file(file), json.dumps(state) + "\n")

    def close() -> None:
        rig.close()
        lock.close()

    try:
        _recall(state_file(file), emulation, rig)
    except BaseException:
        close()
        raise
    rig.start()
    return Plugged(rig.clock, keep, close)


def _parts(rig: EmulatedRig) -> dict[str, Any]:
    return {"fin": rig.fin, "drive": rig.drive, "sensor": rig.sensor}


def _recall(file: Path, emulation: dict[str, Any], rig: EmulatedRig) -> None:
    if not file.exists():
        return
    try:
        state = json.loads(read_bytes(file, LARGEST_STATE))
        if state["emulation"] != emulation:
            raise ValueError("of another seed or tank")
        for name, part in _parts(rig).items():
            part.recall(state[name])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        told = " ".join(str(error).split())[:200]
        raise RigError(
            f"{file}: not the state of this emulated rig ({told}); remove it, and the rig begins anew, not zeroed"
        ) from None


def _locked(file: Path) -> IO[bytes]:
    """The rig's file, open and locked; raises RigError where another process has it."""
    held = file.open("rb")
    # Windows has no such lock; there nobody is told.
    with contextlib.suppress(ImportError):
        import fcntl

        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            held.close()
            raise RigError(
                f"{file}: another command uses this emulated rig; wait for its end, or make another one: "
                "softfin rig emulate --rig OTHER.yaml"
            ) from None
    return held
