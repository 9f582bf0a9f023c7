"""When actions follow each other, and over how many of them forces are averaged."""

import jax
import pytest

from softfin.core.action_clock import PAPER_CLOCK, ActionClock
from softfin.core.errors import ConfigurationError


def test_the_clock_of_the_paper() -> None:
    assert ActionClock.at(3) == PAPER_CLOCK == ActionClock()
    assert PAPER_CLOCK.ticks == (33, 33, 34)
    assert PAPER_CLOCK.rate_hz == 3.0
    assert PAPER_CLOCK.window_ticks == 200
    assert PAPER_CLOCK.max_ticks == 34
    assert str(PAPER_CLOCK) == "3 Hz, window of 2 s"


@pytest.mark.parametrize("rate_hz", [2, 2.5, 3, 4, 5, 6, 7, 8, 9, 10])
@pytest.mark.parametrize("window_s", [1, 1.2, 2])
def test_actions_differ_by_at_most_a_tick_and_fill_the_window(
    rate_hz: float | int, window_s: float | int
) -> None:
    clock = ActionClock.at(rate_hz, window_s)
    assert clock.rate_hz == pytest.approx(rate_hz)
    assert max(clock.ticks) - min(clock.ticks) <= 1
    assert sum(clock.action_ticks(clock.window_actions)) == clock.window_ticks
    cycle_s = sum(clock.ticks) / 100
    assert abs(clock.window_ticks / 100 - window_s) <= cycle_s / 2 or clock.window_actions == len(
        clock.ticks
    )


def test_a_rate_that_ticks_do_not_allow_is_refused() -> None:
    for rate_hz in (3.3, 150):
        with pytest.raises(ConfigurationError, match=f"clock {rate_hz:g} Hz: .*use a rate such as"):
            ActionClock.at(rate_hz)


def test_a_window_that_is_not_a_multiple_of_the_cycle_is_refused() -> None:
    with pytest.raises(ConfigurationError, match=r"window_actions = 4: .*must be a multiple of 3"):
        ActionClock.build({"window_actions": 4})


def test_a_window_of_one_action_is_refused():
    with pytest.raises(ConfigurationError, match=r"window_actions = 1: .*use a longer window"):
        ActionClock.at(1, 1)


def test_the_actions_that_start_within_a_time() -> None:
    assert [PAPER_CLOCK.actions_within(ticks) for ticks in (1, 33, 34, 66, 67, 100, 101)] == [
        1, 1, 2, 2, 3, 3, 4,
    ]  # fmt: skip
    assert ActionClock.at(6).actions_within(300) == 18


def test_a_clock_within_a_pytree_has_no_leaves() -> None:
    tree = (PAPER_CLOCK, jax.numpy.ones(2))
    assert len(jax.tree.leaves(tree)) == 1
    assert jax.jit(lambda tree: tree)(tree)[0] == PAPER_CLOCK


@pytest.mark.parametrize(
    ("stroke_s", "rate_hz", "window_s"),
    [(0.12, 8, 0.75), (0.23, 4, 1.5), (0.31, 3, 2), (0.51, 2, 3), (0.001, 10, 0.6), (9, 1, 6)],
)
def test_the_clock_of_a_stroke_time(
    stroke_s: float | int, rate_hz: float | int, window_s: float | int
) -> None:
    assert ActionClock.for_strokes(stroke_s) == ActionClock.at(rate_hz, window_s)
