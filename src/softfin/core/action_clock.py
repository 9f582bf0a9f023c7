"""The action clock: actions at exactly 3.0 Hz on 100 Hz ticks: 33, 33 and 34 ticks of 10 ms,
repeated; no JAX here."""

ACTION_TICKS = (33, 33, 34)
"""Number of ticks that each action is held, repeated: exactly 3.0 Hz, so six actions are 200
samples."""

MAX_ACTION_TICKS = max(ACTION_TICKS)
"""Rows of an action in a compiled program, where all actions have the same shape; a shorter action
ignores the last row."""

ACTION_RATE_HZ = 3.0

CYCLE_ACTIONS = 2 * len(ACTION_TICKS)
"""Number of actions that fill the evaluation window: a motion that repeats every six, three or two
actions leaves no ripple in its mean."""

WINDOW = 2 * sum(ACTION_TICKS)
"""Number of samples in the mean force by which controllers are judged: 200, that is 2 s or six
actions (paper, Sec. IV-B)."""


def action_ticks(actions: int) -> list[int]:
    """Number of ticks that each of the first `actions` actions is held."""
    return [ACTION_TICKS[action % len(ACTION_TICKS)] for action in range(actions)]


def valid_rows(actions: int) -> list[int]:
    """Indices of the valid rows when the first actions, with `MAX_ACTION_TICKS` rows each, stand
    one after another."""
    return [
        action * MAX_ACTION_TICKS + tick
        for action, ticks in enumerate(action_ticks(actions))
        for tick in range(ticks)
    ]
