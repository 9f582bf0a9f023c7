"""Host process to be killed in a test: it swings a fin until then (``python -m
softfin.rig.commissioning.host BAG``).

It reads the rig's configuration as one line of JSON from standard input, and writes "moves" once
the fin moves. The end of standard input stops the fin, because the parent process is then gone.
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
    """Swing through the full command range until this process is killed or the fin is stopped."""
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
