"""What the commands that move a real fin share: which fin, whether it may move, and how long is left to say no."""

import sys
from dataclasses import dataclass
from typing import TextIO

from softfin.deployment.bench import Bench
from softfin.errors import ConfigurationError
from softfin.printable import printable

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

    def confirm(self, bench: Bench, motion: str | None = None) -> None:
        """Say what is to know of the machine; raise ConfigurationError unless a person says that it may move.

        `motion` is what it will do, if not to follow commands.
        """
        name = bench.machine.name
        for note in bench.machine.notes:
            sys.stderr.write(f"note: {printable(note)}\n")
        if not self.arm:
            told = "answers, and " if motion is None else ""
            raise ConfigurationError(f"{name}: {told}stays still: nothing moves without --arm")
        if self.yes:
            return
        if not on_terminal():
            raise ConfigurationError(f"{name}: --arm asks on a terminal whether it may move; in a script add --yes")
        limits = bench.machine.limits
        motion = motion or (
            f"the fin will move between {limits.angle_min:.2f} and {limits.angle_max:.2f} rad, at up to "
            f"{limits.velocity_max:.2f} rad/s"
        )
        sys.stderr.write(f"{printable(name)}: {motion}.\nCtrl-C stops it. Hands off? Type {WORD!r} and Enter: ")
        sys.stderr.flush()
        if sys.stdin.readline().strip() != WORD:
            raise ConfigurationError(f"{name}: not confirmed with {WORD!r}; nothing moved")
