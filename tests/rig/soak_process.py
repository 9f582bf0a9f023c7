"""A session in a process of its own, which a test pauses: ``python -m tests.rig.soak_process RIG
BAG``."""

import sys
from pathlib import Path

from softfin.core.errors import SoftfinError
from softfin.rig.config import load_rig
from softfin.rig.loop import run_controller
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from tests.rig.machines import Wagging

SAFETY = SafetyConfig(
    current_peak_a=20.0,
    current_sustained_a=10.0,
    overrun_s=0.8,
    stale_s=0.8,
    force_stale_s=0.8,
    watchdog_s=1.2,
    acceleration_rad_s2=1e5,
    velocity_rad_s=100.0,
)


def main() -> None:
    rig = Rig(load_rig(Path(sys.argv[1])))
    told = False

    def tell(sample: object, target: object) -> None:
        nonlocal told
        if target is not None and not told:
            told = True
            sys.stdout.write("moves\n")
            sys.stdout.flush()

    try:
        session = Session(rig, Guard(SAFETY, rig.limits), observers=[tell])
        with session, session.recording(Path(sys.argv[2])):
            session.activate()
            list(run_controller(session, Wagging(), lambda _: (0.0, 0.0), actions=60))
    except SoftfinError as error:
        sys.stderr.write(f"{error}\n")
        raise SystemExit(error.exit_code) from None


main()
