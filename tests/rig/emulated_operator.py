"""An operator beside an emulated rig: turns its shaft, hangs weights on its sensor, pulls its
cables, answers.

What an operator does badly, or finds broken, is set before a step: `answers` overrides what is
answered to a question.
"""

import contextlib
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

from softfin.emulation.rig import EmulatedRig
from softfin.rig.stop import StopRequest


class EmulatedOperator:
    """Meets the Operator contract."""

    def __init__(self, behind: EmulatedRig) -> None:
        self.behind = behind
        self.told: list[str] = []
        self.asked: list[str] = []
        self.answers: dict[str, Any] = {}
        """Answer by a word of the question; otherwise yes, and what the data sheets of the emulated
        rig say."""
        self.weight_kg: float | None = None
        """The weight at hand; None for the one that is named."""
        self.turn_rad_per_deg = math.pi / 180
        self.ignores: set[str] = set()
        """Instructions, by a word, that are not followed."""
        self.interrupts: set[str] = set()
        """Motions, by a word of their instruction, that are stopped by Enter."""
        self._turned_rad = 0.0
        self._wrench = (0.0,) * 6
        self._free_now = behind.fin.now
        behind.fin.now = self._now
        self._is_held_at: float | None = None

    def tell(self, text: str) -> None:
        self.told.append(text)

    def wait(self, instruction: str) -> None:
        self.asked.append(instruction)
        if any(word in instruction for word in self.ignores):
            return
        if degrees := re.search(r"to (\d+) degrees", instruction):
            self._turned_rad = int(degrees[1]) * self.turn_rad_per_deg - self._free_now().angle
        elif "to zero" in instruction:
            self._turned_rad = 0.0
        if axis := re.search(r"along \+([xy])", instruction):
            # A weight pulls the mount: the fin's force on it.
            named = re.search(r"Pull with (\S+) kg", instruction)
            weight_n = 9.81 * (self.weight_kg or float(named[1]))
            self._wrench = tuple(weight_n if name == axis[1] else 0.0 for name in "xyzabc")
        elif "weight off" in instruction:
            self._wrench = (0.0,) * 6
        if "put everything back" in instruction:
            self.behind.drive.plug_in()
            self.behind.sensor.silence(0.0)
        if "Let go" in instruction:
            self._is_held_at = None

    def confirm(self, question: str) -> bool:
        self.asked.append(question)
        return bool(self._answer(question, True))

    def number(self, question: str) -> float:
        self.asked.append(question)
        sheet = {"Encoder lines": 500.0, "Motor turns": 111.0, "Nominal": 10.0}
        usual = next(value for word, value in sheet.items() if word in question)
        return float(self._answer(question, usual))

    def text(self, question: str) -> str:
        return str(self._answer(question, "A. Engineer"))

    @contextlib.contextmanager
    def moving(self, instruction: str, request: StopRequest) -> Iterator[None]:
        self.asked.append(instruction)
        acts: dict[str, Callable[[], object]] = {
            "Ctrl-C": lambda: request.ask("emergency_stop", "stopped by Ctrl-C"),
            "press Enter": lambda: request.ask("emergency_stop", "stopped by a key"),
            "sensor's cable": self.behind.sensor.silence,
            "CAN cable": self.behind.drive.go_silent,
            "CAN adapter": self.behind.drive.go_silent,
            "motor's supply": self.behind.drive.cut_supply,
            "glove": self._hold,
        }
        acts |= dict.fromkeys(self.interrupts, acts["press Enter"])
        act = next((act for word, act in acts.items() if word in instruction), None)
        if act is not None and not any(word in instruction for word in self.ignores):
            self.behind.clock.spawn(lambda: (self.behind.clock.sleep(4.0), act()), "operator")
        yield

    def _answer(self, question: str, usual: Any) -> Any:
        return next((answer for word, answer in self.answers.items() if word in question), usual)

    def _hold(self) -> None:
        self._is_held_at = self._free_now().angle

    def _now(self) -> Any:
        motion = self._free_now()
        angle = motion.angle if self._is_held_at is None else self._is_held_at
        wrench = tuple(map(sum, zip(motion.wrench, self._wrench, strict=True)))
        # The simple fin draws 1 A per rad/s, more than a drive of this kind can supply.
        current = 0.4 * motion.current
        return motion._replace(angle=angle + self._turned_rad, wrench=wrench, current=current)
