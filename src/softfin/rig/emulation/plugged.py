"""The emulated rigs of this process, in simulated time: made once for each rig's file, and remembered beside it.

``rig.state.json`` holds what the next command must find: where the fin stands and how the water moves, the drive's zero,
the sensor's, and how much of the noise has been drawn. One process at a time uses a rig.
"""

import contextlib
import json
from pathlib import Path
from typing import IO, Any

from softfin import artifacts
from softfin.errors import ConfigurationError, RigError
from softfin.files import read_bytes
from softfin.rig.config import RigConfig
from softfin.rig.emulation.rig import EmulatedRig
from softfin.tank import Tank, TankConfig

LARGEST_STATE = 1_000_000
"""Bytes; it has some thousand."""

_rigs: dict[Path, "Plugged"] = {}


def plugged(config: RigConfig) -> "Plugged":
    """The emulated rig that a file describes, as the command before has left it; raises RigError."""
    if config.file is None or config.emulation is None:
        raise RigError("an emulated rig is described by a file that softfin rig emulate writes; load that")
    if config.file not in _rigs:
        _rigs[config.file] = Plugged(config, config.file)
    return _rigs[config.file]


def unplug() -> None:
    """All of this process."""
    while _rigs:
        _rigs.popitem()[1].close()


def state_file(rig: Path) -> Path:
    """Beside the rig's file."""
    return rig.with_suffix(".state.json")


class Plugged:
    """Made in the thread that uses it."""

    def __init__(self, config: RigConfig, file: Path) -> None:
        assert config.emulation is not None
        try:
            tank = Tank(TankConfig.build(config.emulation.tank, f"{file}: emulation.tank"))
        except ConfigurationError as error:
            raise RigError(str(error)) from None
        self._file, self._emulation = file, config.emulation.model_dump(mode="json")
        self._lock = _locked(file)
        self._rig = EmulatedRig(tank, config.emulation.seed, channel=config.bus.channel)
        self.clock = self._rig.clock
        try:
            self._recall()
        except BaseException:
            self.close()
            raise
        self._rig.start()

    def keep(self) -> None:
        """What the next command must find."""
        state = {"emulation": self._emulation}
        state |= {name: part.remembered() for name, part in self._parts().items()}
        artifacts.write_file(state_file(self._file), json.dumps(state) + "\n")

    def close(self) -> None:
        """Let another process have it."""
        self._rig.close()
        self._lock.close()

    def _parts(self) -> dict[str, Any]:
        return {"fin": self._rig.fin, "drive": self._rig.drive, "sensor": self._rig.sensor}

    def _recall(self) -> None:
        file = state_file(self._file)
        if not file.exists():
            return
        try:
            state = json.loads(read_bytes(file, LARGEST_STATE))
            if state["emulation"] != self._emulation:
                raise ValueError("of another seed or tank")
            for name, part in self._parts().items():
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
