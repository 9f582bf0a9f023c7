"""Interaction with the operator at the terminal, who confirms that a real fin may move and stops it
with Enter."""

import contextlib
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple, TextIO

from softfin.core.errors import ConfigurationError
from softfin.core.printable import printable
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.stop import StopRequest, discard_typed_ahead, listen_to_keyboard

WORD = "move"
"""Word that the operator types to let the fin move."""

SAVE_CURSOR = "\x1b7"
RESTORE_CURSOR = "\x1b8"
LINE_UP = "\x1b[A"
ERASE_LINE = "\r\x1b[K"
"""Control sequences of terminals (ECMA-48; cursor sequences as in the VT100)."""


class Arming(NamedTuple):
    """Whether a real fin may move."""

    arm: bool = False
    """Allow the real fin to move after the operator confirms on the terminal."""
    yes: bool = False
    """With `arm`, skip the confirmation."""

    def confirm(
        self, robot: RobotSetup, motion: str | None = None, needs_proof: bool = True
    ) -> None:
        """Print the notes of an open machine and ask the operator to confirm the motion.

        `motion` describes the motion if the machine does not follow commands. `needs_proof` also
        requires `RobotSetup.check_ready` to pass. Raises ConfigurationError if the operator does
        not confirm the motion, and RigError if the rig is not ready.
        """
        name = robot.machine.name
        for note in robot.machine.notes:
            sys.stderr.write(f"note: {printable(note)}\n")
        if not self.arm:
            state = "connected, but not armed" if motion is None else "not armed"
            raise ConfigurationError(f"{name}: {state}; nothing moves without --arm")
        if needs_proof:
            robot.check_ready()
        if self.yes:
            return
        if not on_terminal():
            raise ConfigurationError(
                f"{name}: --arm needs a terminal for the confirmation; in a script, add --yes"
            )
        limits = robot.machine.limits
        motion = motion or (
            f"the fin will move between {limits.angle_min:.2f} and {limits.angle_max:.2f} rad, at "
            f"up to {limits.velocity_max:.2f} rad/s"
        )
        # Enter pressed before the prompt must not be treated as an answer.
        discard_typed_ahead()
        sys.stderr.write(
            f"{printable(name)}: {motion}.\n"
            f"Press Ctrl-C to stop it. Hands clear? Type {WORD!r} and press Enter: "
        )
        sys.stderr.flush()
        if sys.stdin.readline().strip() != WORD:
            raise ConfigurationError(f"{name}: not confirmed with {WORD!r}; nothing moved")


class KeyboardStop:
    """Stops a stage when the operator presses Enter, once the motion is confirmed."""

    def __init__(self, arming: Arming) -> None:
        self.stop = StopRequest()
        """Stop request that Enter triggers."""
        self._arming = arming

    def confirm(self, robot: RobotSetup) -> None:
        """Ask whether the fin may move, then listen for Enter; raises ConfigurationError if the
        operator does not confirm."""
        self._arming.confirm(robot)
        listen_on_terminal(
            self.stop, lambda _: say("the commands are fixed; press Enter alone to stop the fin")
        )


def on_terminal() -> bool:
    """Return whether an operator can answer, i.e. standard input exists and is a terminal."""
    # sys.stdin is None if its descriptor is closed, although its declared type excludes None.
    given: TextIO | None = sys.stdin
    return given is not None and given.isatty()


def listen_on_terminal(stop: StopRequest, line: Callable[[str], None]) -> None:
    """Request a stop on Enter or when the terminal input ends; call `line` with any other input."""
    if on_terminal() and not _in_background():
        listen_to_keyboard(stop, line, typed(stop, sys.stdin))


def _in_background() -> bool:
    """Return whether this is a background job (&), which reading would suspend in the middle of a
    motion."""
    try:
        return os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp()
    except OSError:
        # A terminal that does not control this session has no job control.
        return False


def typed(stop: StopRequest, terminal: Iterable[str]) -> Iterator[str]:
    """Yield the lines typed on the terminal. If the input ends or is not text, request an emergency
    stop, because no key can stop the fin any more."""
    with contextlib.suppress(OSError, ValueError):
        for line in terminal:
            STATUS.release()
            yield line
    stop.ask(
        "emergency_stop", "the terminal input ended or is not text, so no key could stop the fin"
    )


class StatusLine:
    """The state of a run on standard error, updated in place above the line on which the operator
    types. Without a terminal, each state is printed on a new line."""

    def __init__(self) -> None:
        self._is_shown = False

    def show(self, state: str, keys: str) -> None:
        """Replace the state; `keys` describes what the operator may type."""
        if not sys.stderr.isatty():
            self.say(state)
            return
        state = state[: shutil.get_terminal_size().columns - 1]
        text = f"{state}\n{keys}"
        if self._is_shown:
            text = f"{SAVE_CURSOR}{LINE_UP}{ERASE_LINE}{state}{RESTORE_CURSOR}"
        # Set first, because the operator may press Enter in the meantime.
        self._is_shown = True
        sys.stderr.write(text)
        sys.stderr.flush()

    def say(self, text: str) -> None:
        """Print a permanent line; the next state is shown below it."""
        self.clear()
        sys.stderr.write(printable(text) + "\n")

    def clear(self) -> None:
        """Erase the input line of the operator, if there is one; the last state stays."""
        if self._is_shown:
            sys.stderr.write(ERASE_LINE)
        self.release()

    def release(self) -> None:
        """Show the next state on a new line, because the operator pressed Enter."""
        self._is_shown = False


STATUS = StatusLine()
"""The only status line, because there is only one terminal."""


def say(text: str) -> None:
    """Print a line on the terminal."""
    STATUS.say(text)
