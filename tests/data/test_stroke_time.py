"""How long a fin's strokes take, from its logs."""

import numpy as np
import pytest

from softfin.core.quantities import Command, Log, Reading
from softfin.data.stroke_time import stroke_time


def _log(stroke_s: float | int, hold_s: float | int, strokes: int = 40, turn: float = 1.0) -> Log:
    """A shaft that turns to each new angle at constant speed, 90% of the way in `stroke_s`."""
    hold = round(hold_s * 100)
    target = np.repeat(np.resize((turn, 0.0), strokes), hold).astype(np.float32)
    angle = np.zeros_like(target)
    for row in range(1, len(target)):
        step = 0.9 * turn / (stroke_s * 100)
        angle[row] = angle[row - 1] + np.clip(target[row] - angle[row - 1], -step, step)
    zeros = np.zeros_like(target)
    time = (np.arange(len(target)) / 100).astype(np.float32)
    reading = Reading(time, angle, zeros, np.zeros((len(target), 2), np.float32))
    return Log(Command(target, zeros), reading)


@pytest.mark.parametrize("stroke_s", [0.1, 0.3, 0.7])
def test_the_time_until_the_shaft_has_almost_arrived(stroke_s: float) -> None:
    short = _log(stroke_s, 0.05, turn=0.2)
    assert stroke_time([_log(stroke_s, 1.0), short]) == pytest.approx(stroke_s, abs=0.02)


def test_commands_that_are_never_held_as_briefly_as_a_stroke_set_the_time() -> None:
    assert stroke_time([_log(0.13, 0.35)]) == pytest.approx(0.35)


def test_strokes_that_are_cut_short_count_as_long() -> None:
    whole = _log(0.3, 0.5, strokes=20)
    cut = _log(0.9, 0.2, strokes=400)
    assert stroke_time([whole]) is not None
    assert stroke_time([whole, cut]) is None


def test_few_or_small_strokes_say_nothing() -> None:
    assert stroke_time([_log(0.3, 1.0, strokes=6)]) is None
    assert stroke_time([_log(0.3, 1.0, turn=0.2)]) is None
