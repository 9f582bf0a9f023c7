"""A host that is made to die: it swings a fin until it is killed; ``python -m
softfin.rig.commissioning.host BAG``.

Its rig comes as JSON on standard input; it writes "moves" once the fin moves.
"""

import json
import sys
from pathlib import Path

from softfin.rig.commissioning.motion import move, stroke_ticks, swings
from softfin.rig.config import RigConfig
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.stop import StopRequest


def main() -> None:
    """Swing through the whole range of the rig's commands, until this process is killed or the fin
    is stopped."""
    config = RigConfig.build(json.load(sys.stdin), "rig")
    drive = config.drive
    has_told = False

    def tell(_: Sample, target: Target | None) -> None:
        nonlocal has_told
        if target is not None and abs(target.angle) > 0.5 * drive.angle_max_rad and not has_told:
            has_told = True
            sys.stdout.write("moves\n")
            sys.stdout.flush()

    ticks = stroke_ticks(drive.angle_max_rad, drive.fastest_rad_s)
    targets = swings(drive.angle_max_rad, drive.fastest_rad_s)
    stopped = move(Rig(config), targets, ticks, StopRequest(), Path(sys.argv[1]), [tell])
    sys.stdout.write(f"{stopped.reason}\n")


if __name__ == "__main__":
    main()
