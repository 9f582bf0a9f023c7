"""The emulated rigs of this process, in simulated time: one for each rig's file, with its state kept beside the file.

``rig.state.json`` holds what the next command must find: where the fin stands and how the water moves, the zero of the
drive and of the sensor, and how much of the noise has been drawn. One process at a time uses a rig.
"""

import contextlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import IO, NamedTuple

from softfin.core.errors import ConfigurationError, RigError
from softfin.rig.config import RigConfig
from softfin.rig.emulation.rig import EmulatedRig
from softfin.rig.simulated_clock import SimulatedClock
from softfin.storage import artifact as artifacts
from softfin.tank import Tank, TankConfig


class KeptRig(NamedTuple):
    """An emulated rig for its host."""

    clock: SimulatedClock
    """Made in the thread that uses the rig."""
    save: Callable[[], None]
    """Writes the state for the next command."""
    close: Callable[[], None]
    """Closes the rig, and lets another process use it."""


_rigs: dict[Path, KeptRig] = {}


def kept_rig(config: RigConfig) -> KeptRig:
    """The emulated rig that a file describes, as the command before has left it; raises RigError."""
    if config.file is None:
        raise RigError("an emulated rig is described by a file that softfin rig emulate writes; load that")
    if config.file not in _rigs:
        register_rig(config.file, _open(config, config.file))
    return _rigs[config.file]


def register_rig(file: Path, rig: KeptRig) -> None:
    """Use a rig for that file from now on."""
    _rigs[file.resolve()] = rig


def close_rigs() -> None:
    """Close all rigs of this process."""
    while _rigs:
        _rigs.popitem()[1].close()


def state_file(rig: Path) -> Path:
    """File of the state, beside the rig's file."""
    return rig.with_suffix(".state.json")


def _open(config: RigConfig, file: Path) -> KeptRig:
    assert config.emulation is not None
    try:
        tank = Tank(TankConfig.build(config.emulation.tank, f"{file}: emulation.tank"))
    except ConfigurationError as error:
        raise RigError(str(error)) from None
    emulation, path = config.emulation.model_dump(mode="json"), state_file(file)
    lock, clock = _lock(file), SimulatedClock()
    rig = EmulatedRig(tank, config.emulation.seed, channel=config.bus.channel, clock=clock)
    parts = {"fin": rig.fin, "drive": rig.drive, "sensor": rig.sensor}

    def save() -> None:
        state = {"emulation": emulation} | {name: part.remembered() for name, part in parts.items()}
        artifacts.write_file(path, json.dumps(state) + "\n")

    def close() -> None:
        rig.close()
        lock.close()

    try:
        if path.exists():
            state = json.loads(path.read_bytes())
            if state["emulation"] != emulation:
                raise ValueError("of another seed or tank")
            for name, part in parts.items():
                part.recall(state[name])
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        close()
        raise RigError(
            f"{path}: not the state of this emulated rig ({' '.join(str(error).split())[:200]}); remove it, and the "
            "rig begins anew, not zeroed"
        ) from None
    rig.start()
    return KeptRig(clock, save, close)


def _lock(file: Path) -> IO[bytes]:
    """The rig's file, open and locked; raises RigError where another process has it."""
    held = file.open("rb")
    # Windows has no such lock.
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
