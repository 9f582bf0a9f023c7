"""Emulated rigs for tests: their limits in time are wide, because the machine that runs the tests is shared."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml

from softfin.deployment.bench import Bench
from softfin.rig.emulation.rig import EmulatedRig
from softfin.rig.emulation.simple import SimpleFin
from softfin.rig.rig import Rig
from softfin.tank import Tank

SAFETY = {
    "current_peak_a": 20.0, "current_sustained_a": 10.0, "overrun_s": 1.0, "stale_s": 1.0, "force_stale_s": 1.0,
    "watchdog_s": 2.0, "acceleration_rad_s2": 1e5, "velocity_rad_s": 100.0, "following_s": 2.0,
}  # fmt: skip


def wide(emulated: EmulatedRig, same_process: bool = True, **safety: Any) -> dict[str, Any]:
    """What its file holds."""
    values = emulated.values(same_process, safety=SAFETY | safety, settle_s=0.1)
    values["drive"] |= {"heartbeat_s": 3.0, "sync_s": 0.02, "zero_needed": False}
    return values


@contextmanager
def emulated(tank: Tank | None = None, **safety: Any) -> Iterator[tuple[EmulatedRig, Bench]]:
    """With a fin that needs no JAX, unless a tank is given."""
    with patient(), EmulatedRig(tank, fin=None if tank else SimpleFin()) as behind:
        values = wide(behind, **safety)
        del values["bus"]
        yield behind, bench_of(behind, **values)


@contextmanager
def patient() -> Iterator[None]:
    """On a busy machine the emulated sensor is silent at times; no more than its age is judged then."""
    with pytest.MonkeyPatch.context() as patches:
        patches.setattr("softfin.rig.axia80.SILENT_S", 2.0)
        yield


def bench_of(behind: EmulatedRig, **changes: Any) -> Bench:
    config = behind.config(**changes)
    return Bench(Rig(config), config.safety, config.fin, config.settle_s, config.model_dump(mode="json"))


def write_wide(behind: EmulatedRig, path: Path, **safety: Any) -> Path:
    """Its file, for the command line in this process."""
    path.write_text(yaml.safe_dump(wide(behind, **safety)))
    return path
