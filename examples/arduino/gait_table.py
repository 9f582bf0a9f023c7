"""Writes the gaits of a map as a header file for play_gait.ino, which plays them on a hobby servo.

    python examples/arduino/gait_table.py gaits examples/arduino/play_gait/gaits.h

The file has one row per target force. A row lists the commanded angles of one period, in tenths of a degree.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import softfin
from softfin import Measured

MAX_DECIDEGREES = 1800
AT_REST = Measured(np.float32(0), np.zeros(2, np.float32))
"""A gait ignores the measurements."""


def gait_decidegrees(
    controller: Any, force_n: tuple[float, float], centre_deg: float, sign: int = 1
) -> list[int]:
    """Return the commanded angles of one period of a gait, as the servo counts them; `sign` is -1 if
    positive angles of the fin decrease the servo angle."""
    state = controller.init()
    angles = []
    for _ in range(controller.clock.window_actions):
        state, command = controller.act(state, AT_REST, np.asarray(force_n))
        angles.append(round(10 * (centre_deg + sign * np.rad2deg(command.angle))))
    return angles


def header(controller: Any, forces_per_axis: int, centre_deg: float, sign: int = 1) -> str:
    """Return the text of gaits.h, with the reachable forces of a square lattice."""
    forces = [
        force
        for force in controller.cells[0].lattice(forces_per_axis)
        if controller.reachable.contains(force)
    ]
    rows = []
    for number, force in enumerate(forces, 1):
        angles = gait_decidegrees(controller, force, centre_deg, sign)
        if not 0 <= min(angles) <= max(angles) <= MAX_DECIDEGREES:
            sys.exit(
                "gait_table.py: angles outside 0 to 180 degrees; set --centre to the servo angle at which the fin points along -x"
            )
        rows.append(
            f"  {{{', '.join(map(str, angles))}}},  // {number}: {force[0]:.3f}, {force[1]:.3f} N"
        )
    actions = controller.clock.window_actions
    millis = ", ".join(str(10 * ticks) for ticks in controller.clock.action_ticks(actions))
    return "\n".join(
        [
            f"// Gaits of {controller.artifact.name}, written by gait_table.py. Row: target force along x, y.",
            f"const int ROWS = {len(rows)};",
            f"const int ACTIONS = {actions};",
            f"const int CENTRE_DECIDEGREES = {round(10 * centre_deg)};",
            f"const unsigned int MILLIS[ACTIONS] = {{{millis}}};",
            "const int DECIDEGREES[ROWS][ACTIONS] PROGMEM = {",
            *rows,
            "};\n",
        ]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("gaits", type=Path, help="controller folder of softfin map")
    parser.add_argument("out", type=Path, help="header file to write")
    parser.add_argument("--forces", type=int, default=7, help="target forces along each axis")
    parser.add_argument(
        "--centre", type=float, default=90, help="servo angle at angle 0 [deg], as in --angle-zero"
    )
    parser.add_argument(
        "--negate",
        action="store_true",
        help="if the logs were read with --negate command_angle, alone or with others",
    )
    arguments = parser.parse_args()
    controller = softfin.load_controller(arguments.gaits)
    if controller.kind != "gaits":
        sys.exit(
            f"{arguments.gaits}: controller is not a table of gaits; use a folder of softfin map"
        )
    if controller.limits.velocity_min < controller.limits.velocity_max:
        print(
            "warning: these gaits also command velocities, which a hobby servo cannot follow; fit with "
            "--velocity instead of a column of velocities",
            file=sys.stderr,
        )
    sign = -1 if arguments.negate else 1
    text = header(controller, arguments.forces, arguments.centre, sign)
    arguments.out.write_text(text)
    way = "decrease" if arguments.negate else "increase"
    print(
        f"{arguments.out}: {text.count(' N')} gaits; the fin's angle 0 is servo angle "
        f"{arguments.centre:g} degrees, and positive angles {way} the servo angle. Check that "
        "--centre equals --angle-zero of the import in degrees, and that --negate is set only if the "
        "import had --negate command_angle; otherwise the fin pushes in the wrong direction"
    )


if __name__ == "__main__":
    main()
