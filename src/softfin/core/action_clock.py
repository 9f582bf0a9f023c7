"""The action clock: actions at exactly 3.0 Hz on 100 Hz ticks, in a cycle of 33, 33 and 34 ticks of
10 ms. No JAX."""

ACTION_TICKS = (33, 33, 34)
"""Durations of consecutive actions [ticks], repeated in this order. The rate is exactly 3.0 Hz, so
six actions last 200 samples."""

MAX_ACTION_TICKS = max(ACTION_TICKS)
"""Number of rows per action in a compiled program, where all actions have the same shape; a shorter
action ignores the last row."""

ACTION_RATE_HZ = 3.0

CYCLE_ACTIONS = 2 * len(ACTION_TICKS)
"""Number of actions in the evaluation window: a motion that repeats every six, three or two actions
causes no ripple in the window's mean."""

WINDOW = 2 * sum(ACTION_TICKS)
"""Number of samples in the mean force used to evaluate controllers: 200, i.e. 2 s or six actions
(paper, Sec. IV-B)."""


def action_ticks(actions: int) -> list[int]:
    """Return the durations of the first `actions` actions [ticks]."""
    return [ACTION_TICKS[action % len(ACTION_TICKS)] for action in range(actions)]


def valid_rows(actions: int) -> list[int]:
    """Return the indices of the valid rows among the concatenated rows of the first actions,
    `MAX_ACTION_TICKS` rows each."""
    return [
        action * MAX_ACTION_TICKS + tick
        for action, ticks in enumerate(action_ticks(actions))
        for tick in range(ticks)
    ]
