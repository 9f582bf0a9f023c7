"""Counts what JAX traces, lowers and compiles, program by program, from JAX's own monitoring."""

import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from jax import monitoring

import softfin

TRACE = "/jax/core/compile/jaxpr_trace_duration"
LOWER = "/jax/core/compile/jaxpr_to_mlir_module_duration"
XLA = "/jax/core/compile/backend_compile_duration"
"""A program that is read from the persistent cache counts too, with the time that reading takes."""

HIT = "/jax/compilation_cache/cache_hits"

PACKAGE = str(Path(softfin.__file__).parent)


class Compilation:
    """Counts from its making on; in each thread, what happens within another span is taken off that
    span."""

    def __init__(self) -> None:
        self.seconds_of: Counter[tuple[str, str]] = Counter()
        """Seconds by event, and by function and where it was called."""
        self.programs_of: Counter[str] = Counter()
        """Programs by function and where it was called."""
        self.cache_hits = 0
        self._threads: dict[int, list[tuple[float, float]]] = {}
        monitoring.register_event_duration_secs_listener(self._note_span)
        monitoring.register_event_listener(self._note_event)

    def _note_span(self, event: str, seconds: float, **details: Any) -> None:
        if event not in (TRACE, LOWER, XLA):
            return
        name = (
            f"{str(details.get('fun_name', '?')).removeprefix('jit(').removesuffix(')')} "
            f"{_caller()}"
        )
        end = time.perf_counter()
        start = end - seconds
        spans = self._threads.setdefault(threading.get_ident(), [])
        own = seconds
        while spans and spans[-1][0] >= start:
            inner_start, inner_end = spans.pop()
            own -= inner_end - inner_start
        spans.append((start, end))
        self.seconds_of[event, name] += own
        if event == XLA:
            self.programs_of[name] += 1

    def _note_event(self, event: str, **_: Any) -> None:
        self.cache_hits += event == HIT

    @property
    def programs(self) -> int:
        """How many programs were compiled, or read from the persistent cache."""
        return sum(self.programs_of.values())

    def seconds(self, *events: str) -> float:
        """Of the given events, of all where none is given."""
        return sum(
            seconds
            for (event, _), seconds in self.seconds_of.items()
            if not events or event in events
        )


def _caller() -> str:
    """The innermost line of softfin's that is being executed."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_code.co_filename.startswith(PACKAGE):
            return f"{Path(frame.f_code.co_filename).relative_to(PACKAGE)}:{frame.f_lineno}"
        frame = frame.f_back
    return "elsewhere"
