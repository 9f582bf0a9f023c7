"""What the commands that move a real fin share: which fin, whether it may move, and how long is left to say no."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from softfin.cli.common import Common
from softfin.cli.kinds import Controller, File, LivePlant
from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable

if TYPE_CHECKING:
    from softfin.rig.robot_setup import RobotSetup

WORD = "move"


def on_terminal() -> bool:
    """Whether a person may be there to answer; a program that was started without an input has none at all."""
    # Python leaves it out where the descriptor was closed, which its types do not say.
    given: TextIO | None = sys.stdin
    return given is not None and given.isatty()


@dataclass(frozen=True, kw_only=True)
class Armed:
    """Options of every command that may move a real fin."""

    arm: bool = False
    """With --plant rig or ros2: the fin may move, once you confirm it on the terminal."""
    yes: bool = False
    """With --arm, do not ask: for scripts. Nobody stands by, so see that nobody can come near the fin."""

    def confirm(self, robot: "RobotSetup", motion: str | None = None) -> None:
        """Say what is to know of the machine; raise ConfigurationError unless a person says that it may move.

        `motion` is what it will do, if not to follow commands.
        """
        name = robot.machine.name
        for note in robot.machine.notes:
            sys.stderr.write(f"note: {printable(note)}\n")
        if not self.arm:
            told = "answers, and " if motion is None else ""
            raise ConfigurationError(f"{name}: {told}stays still: nothing moves without --arm")
        if self.yes:
            return
        if not on_terminal():
            raise ConfigurationError(f"{name}: --arm asks on a terminal whether it may move; in a script add --yes")
        limits = robot.machine.limits
        motion = motion or (
            f"the fin will move between {limits.angle_min:.2f} and {limits.angle_max:.2f} rad, at up to "
            f"{limits.velocity_max:.2f} rad/s"
        )
        sys.stderr.write(f"{printable(name)}: {motion}.\nCtrl-C stops it. Hands off? Type {WORD!r} and Enter: ")
        sys.stderr.flush()
        if sys.stdin.readline().strip() != WORD:
            raise ConfigurationError(f"{name}: not confirmed with {WORD!r}; nothing moved")


@dataclass(frozen=True, kw_only=True)
class Driving(Armed, Common):
    """Options of every command that has a controller drive a real fin; `softfin.cli.driving` does so."""

    controller: Controller
    """Folder of the controller."""
    plant: LivePlant = "rig"
    """The fin: rig (rig.yaml), ros2, or one of these with :FILE."""
    seconds: int | None = None
    """How long; without it until you stop it."""
    bag: File | None = None
    """The recording, a ROS 2 bag, NAME.mcap (run-DATE.mcap)."""
    strict: bool = False
    """Refuse a reference that the fin cannot make; else the nearest one that it can make is held, with a warning."""
    trim: bool = False
    """Take off, slowly, what the fin makes besides what it is asked for, from the measured mean force."""

    def check(self) -> None:
        """Before anything moves: what is there is neither moved nor replaced, unless a person says so."""
        if self.seconds is not None and self.seconds < 1:
            raise ConfigurationError(f"--seconds {self.seconds}: at least 1; leave it out to run until you stop it")
        if self.bag is not None:
            _check_bag(self.bag, self.overwrite)
        super().check()


def _check_bag(bag: Path, overwrite: bool) -> None:
    if bag.suffix != ".mcap":
        raise ConfigurationError(f"--bag {bag}: a recording is a file NAME.mcap")
    if bag.is_dir() or (bag.exists() and not overwrite):
        raise ConfigurationError(f"--bag {bag}: exists already; give another one, or --overwrite to replace it")
