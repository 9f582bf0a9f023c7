"""A host that is made to die: it swings a fin until it is killed; ``python -m
softfin.rig.commissioning.host BAG``.

Its rig comes as a line of JSON on standard input. The end of that input stops the fin: then the
program that started this one is gone. It writes "moves" once the fin moves.
"""

import json
import sys
import threading
from pathlib import Path

from softfin.rig.commissioning.motion import move, stroke_ticks, swings
from softfin.rig.config import RigConfig
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.stop import StopRequest


def main() -> None:
    """Swing through the whole range of the rig's commands, until this process is killed or the fin
    is stopped."""
    config = RigConfig.build(json.loads(sys.stdin.readline()), "rig")
    request = StopRequest()

    def await_end() -> None:
        sys.stdin.read()
        request.ask("emergency_stop", "the commissioning has ended")

    threading.Thread(target=await_end, name="commissioning", daemon=True).start()
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
    stopped = move(Rig(config), targets, ticks, request, Path(sys.argv[1]), [tell])
    sys.stdout.write(f"{stopped.reason}\n")


if __name__ == "__main__":
    main()
