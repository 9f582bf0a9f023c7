"""The action clock: 3.0 Hz over 100 Hz exactly, 33, 33 and 34 ticks of 10 ms, again and again; no
JAX here."""

ACTION_TICKS = (33, 33, 34)
"""Ticks that each action is held, again and again: 3.0 Hz over 100 Hz exactly, so six actions are
200 samples."""

MAX_ACTION_TICKS = max(ACTION_TICKS)
"""Rows of an action in a program, in which all actions have one shape; of a shorter one the last
row does not count."""

ACTION_RATE_HZ = 3.0

CYCLE_ACTIONS = 2 * len(ACTION_TICKS)
"""Actions that fill the evaluation window: what repeats every six, three or two leaves no ripple in
its mean."""

WINDOW = 2 * sum(ACTION_TICKS)
"""Samples whose mean force controllers are judged by: 200, 2 s, six actions (paper, Sec. IV-B)."""


def action_ticks(actions: int) -> list[int]:
    """Ticks that each of the first so many actions is held."""
    return [ACTION_TICKS[action % len(ACTION_TICKS)] for action in range(actions)]


def valid_rows(actions: int) -> list[int]:
    """Rows that count, of the first so many actions with `MAX_ACTION_TICKS` rows each, one after
    the other."""
    return [
        action * MAX_ACTION_TICKS + tick
        for action, ticks in enumerate(action_ticks(actions))
        for tick in range(ticks)
    ]
