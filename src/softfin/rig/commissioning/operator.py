"""The operator at the rig, who follows a step's instructions and answers its questions; tests
emulate one."""

import contextlib
import queue
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, runtime_checkable

from softfin.core.errors import RunError
from softfin.core.printable import printable
from softfin.rig.stop import SIGNAL_CHECK_S, StopRequest, discard_typed_ahead


@runtime_checkable
class Operator(Protocol):
    """Interface of the steps to the operator."""

    def tell(self, text: str) -> None:
        """Show a line."""

    def wait(self, instruction: str) -> None:
        """Show an instruction, and return once it has been carried out."""

    def confirm(self, question: str) -> bool:
        """Ask a yes-or-no question."""

    def number(self, question: str) -> float:
        """Ask for a number."""

    def text(self, question: str) -> str:
        """Ask for a non-empty line of text."""

    def moving(self, instruction: str, request: StopRequest) -> AbstractContextManager[None]:
        """Show an instruction for the fin, which moves within this context; pressing Enter requests
        a stop."""


class TerminalOperator:
    """An operator at the terminal.

    A thread reads every line, so that Enter stops a moving fin immediately and a line typed for one
    question cannot answer the next.
    """

    def __init__(
        self, lines: Iterable[str] | None = None, write: Callable[[str], object] | None = None
    ) -> None:
        self._write = write or sys.stderr.write
        self._answers: queue.Queue[str | None] = queue.Queue()
        self._request: StopRequest | None = None
        self._is_terminal = lines is None
        source = sys.stdin if lines is None else lines
        threading.Thread(target=self._read, args=(source,), name="operator", daemon=True).start()

    def tell(self, text: str) -> None:
        """Show a line."""
        self._write(f"{printable(text)}\n")

    def wait(self, instruction: str) -> None:
        """Show an instruction, and return once Enter is pressed."""
        self._ask(f"{instruction}; press Enter when done: ")

    def confirm(self, question: str) -> bool:
        """Ask until the answer is yes or no."""
        while True:
            answer = self._ask(f"{question} [yes/no]: ").casefold()
            if answer in ("yes", "y", "no", "n"):
                return answer.startswith("y")

    def number(self, question: str) -> float:
        """Ask until the answer is a number."""
        while True:
            answer = self._ask(f"{question}: ")
            try:
                return float(answer)
            except ValueError:
                self.tell(f"{answer!r}: not a number; type a number, e.g. 2.5")

    def text(self, question: str) -> str:
        """Ask until the answer is not empty."""
        while True:
            if answer := self._ask(f"{question}: "):
                return answer

    @contextmanager
    def moving(self, instruction: str, request: StopRequest) -> Iterator[None]:
        """Show an instruction for the moving fin; pressing Enter stops it."""
        self.tell(f"{instruction} (Enter stops the fin)")
        self._request = request
        try:
            yield
        finally:
            self._request = None

    def _ask(self, prompt: str) -> str:
        if self._is_terminal:
            self._discard_typed_ahead()
        self._write(printable(prompt))
        answer = self._next_line()
        if answer is None:
            # Keep the end-of-input marker, so that the next question does not wait forever.
            self._answers.put(None)
            raise RunError(
                "commissioning: the terminal's input has ended; run the command again to resume "
                "at this step"
            )
        return answer

    def _discard_typed_ahead(self) -> None:
        """Discard lines typed before the question: an earlier Enter must not answer it."""
        discard_typed_ahead()
        with contextlib.suppress(queue.Empty):
            while self._answers.get_nowait() is not None:
                pass
            # Keep the end-of-input marker.
            self._answers.put(None)

    def _next_line(self) -> str | None:
        while True:
            with contextlib.suppress(queue.Empty):
                # With a timeout, so that the main thread also handles signals.
                return self._answers.get(timeout=SIGNAL_CHECK_S)

    def _read(self, lines: Iterable[str]) -> None:
        try:
            for line in lines:
                request = self._request
                if request is None:
                    self._answers.put(line.strip())
                elif not line.strip():
                    request.ask("emergency_stop", "stopped by a key")
        except (OSError, ValueError):
            # Binary input or a closed terminal is treated as the end of the input.
            pass
        if (request := self._request) is not None:
            request.ask(
                "emergency_stop", "the terminal's input ended, so no key could stop the fin"
            )
        self._answers.put(None)
