"""What the commands that move a real fin share: which fin, whether it may move, and how long is left to say no."""

import sys
from dataclasses import dataclass

from softfin.deployment.bench import Bench
from softfin.errors import ConfigurationError

WORD = "move"


@dataclass(frozen=True, kw_only=True)
class Armed:
    """Options of every command that may move a real fin."""

    arm: bool = False
    """With --plant rig or ros2: the fin may move, once you confirm it on the terminal."""
    yes: bool = False
    """With --arm, do not ask: for scripts. Nobody stands by, so see that nobody can come near the fin."""

    def confirm(self, bench: Bench) -> None:
        """Raise ConfigurationError unless a person says that the fin may move."""
        name = bench.machine.name
        if not self.arm:
            raise ConfigurationError(f"{name}: answers, and stays still: nothing moves without --arm")
        if self.yes:
            return
        if not sys.stdin.isatty():
            raise ConfigurationError(f"{name}: --arm asks on a terminal whether it may move; in a script add --yes")
        limits = bench.machine.limits
        sys.stderr.write(
            f"{name}: the fin will move between {limits.angle_min:.2f} and {limits.angle_max:.2f} rad, at up to "
            f"{limits.velocity_max:.2f} rad/s.\nCtrl-C stops it. Hands off? Type {WORD!r} and Enter: "
        )
        sys.stderr.flush()
        if sys.stdin.readline().strip() != WORD:
            raise ConfigurationError(f"{name}: not confirmed with {WORD!r}; nothing moved")
