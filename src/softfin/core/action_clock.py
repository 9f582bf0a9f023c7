"""The action clock: the durations of actions, and the number of actions over which forces are
averaged.

The paper's clock is `PAPER_CLOCK`: actions at exactly 3.0 Hz on ticks of 10 ms, which last 33, 33
and 34 ticks in turn, and windows of six actions, 2 s. No JAX.
"""

import math
from fractions import Fraction
from itertools import accumulate

from pydantic import Field, PositiveInt, model_validator

from softfin.core.configuration import Configuration
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import RATE_HZ, TICK_S

PROPOSED_RATES_HZ = (1, 1.25, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10)
"""Rates that `for_strokes` chooses from."""
PROPOSED_ACTIONS = 6
"""Number of actions in the windows of `for_strokes`, as in the paper (Sec. IV-B)."""
MAX_CYCLE_ACTIONS = 20
"""Maximum number of actions of different durations, which limits the rates that `at` accepts."""


class ActionClock(Configuration):
    """Durations of actions, and the window in which forces are averaged.

    The window is a multiple of the cycle, so it has the same length at every action. A motion with
    the period of the window causes no ripple in the mean.
    """

    ticks: tuple[PositiveInt, ...] = Field((33, 33, 34), min_length=1, max_length=MAX_CYCLE_ACTIONS)
    """Durations of consecutive actions [ticks of 10 ms], repeated in this order."""
    window_actions: PositiveInt = 6
    """Number of actions in the window; a motion with the period of the window causes no ripple in
    the mean."""

    @model_validator(mode="after")
    def _is_valid(self) -> "ActionClock":
        if self.window_actions < 2:
            raise ValueError(
                f"window_actions = {self.window_actions}: a gait of one action does not move; use "
                "a longer window or a higher rate"
            )
        if self.window_actions % len(self.ticks):
            raise ValueError(
                f"window_actions = {self.window_actions}: must be a multiple of {len(self.ticks)} "
                "(one clock cycle)"
            )
        return self

    @classmethod
    def at(cls, rate_hz: float | int, window_s: float | int = 2) -> "ActionClock":
        """Build the clock with a rate [Hz] and the window nearest to `window_s`; the durations of
        its actions differ by at most one tick.

        Raises:
            ConfigurationError: If the rate is not a ratio of small integers, or is above 100 Hz.
        """
        ticks_per_action = Fraction(RATE_HZ / rate_hz).limit_denominator(MAX_CYCLE_ACTIONS)
        count = ticks_per_action.denominator
        if ticks_per_action < 1 or abs(float(ticks_per_action) * rate_hz * TICK_S - 1) > 1e-6:
            raise ConfigurationError(
                f"clock {rate_hz:g} Hz: actions of 10 ms ticks cannot have this rate; use a rate "
                "such as 2, 2.5, 3, 4, 5, 6 or 10"
            )
        ends = [int(ticks_per_action * (action + 1)) for action in range(count)]
        ticks = tuple(end - start for start, end in zip([0, *ends[:-1]], ends, strict=True))
        cycles = max(1, round(window_s * RATE_HZ / ends[-1]))
        return cls.build(
            {"ticks": ticks, "window_actions": cycles * count}, f"clock {rate_hz:g} Hz"
        )

    @classmethod
    def for_strokes(cls, stroke_s: float | int) -> "ActionClock":
        """Build the clock whose actions last about as long as a fin's strokes [s], with a window of
        six actions.

        The stroke time of the paper's fin (0.31 s in the tank) gives the paper's clock.
        """
        rate_hz = min(PROPOSED_RATES_HZ, key=lambda rate: abs(math.log(rate * stroke_s)))
        return cls.at(rate_hz, PROPOSED_ACTIONS / rate_hz)

    @classmethod
    def parse(cls, text: str) -> "ActionClock":
        """Parse ``paper``, a rate [Hz], or a rate and a window [s] such as ``6,1``; raises
        ConfigurationError if the text is invalid."""
        if text == "paper":
            return cls()
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) not in (1, 2) or not all(0 < number < math.inf for number in numbers):
            raise ConfigurationError(
                f"--clock {text}: must be paper, auto, a rate in Hz such as 6, or a rate and a "
                "window in s such as 6,1"
            )
        return cls.at(*numbers)

    @property
    def max_ticks(self) -> int:
        """Number of rows per action in a compiled program, where all actions have the same shape;
        shorter actions ignore the last rows."""
        return max(self.ticks)

    @property
    def rate_hz(self) -> float:
        """Mean rate of the actions [Hz]."""
        return len(self.ticks) * RATE_HZ / sum(self.ticks)

    @property
    def window_ticks(self) -> int:
        """Number of samples in the window."""
        return self.window_actions // len(self.ticks) * sum(self.ticks)

    def actions_within(self, ticks: int) -> int:
        """Return the number of actions that start within a number of ticks."""
        cycles, rest = divmod(ticks, sum(self.ticks))
        starts = list(accumulate(self.ticks, initial=0))
        return cycles * len(self.ticks) + sum(start < rest for start in starts[:-1])

    def action_ticks(self, actions: int) -> list[int]:
        """Return the durations of the first `actions` actions [ticks]."""
        return [self.ticks[action % len(self.ticks)] for action in range(actions)]

    def valid_rows(self, actions: int) -> list[int]:
        """Return the indices of the valid rows among the concatenated rows of the first actions,
        which have `max_ticks` rows each."""
        return [
            action * self.max_ticks + tick
            for action, ticks in enumerate(self.action_ticks(actions))
            for tick in range(ticks)
        ]

    def __str__(self) -> str:
        return f"{self.rate_hz:.4g} Hz, window of {self.window_ticks * TICK_S:g} s"


PAPER_CLOCK = ActionClock()
"""Actions at 3.0 Hz and a window of 2 s (paper, Sec. IV-B)."""
