import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from softfin.core.errors import LogError
from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate.streaming.segments import MAX_DELAY, Table, measure_scales
from tests.surrogate.streaming import small


def numbered(rows, log):
    """Every row of every log holds its own number: thousands for the log, units for the row."""
    row = (1000 * (log + 1) + np.arange(rows)).astype(np.float32)
    return Log(Command(row, row), Reading(row, row, row, np.stack([row, row], axis=1)))


@settings(max_examples=15, deadline=None)
@given(rows=st.lists(st.integers(20, 120), min_size=1, max_size=4), ticks=st.integers(2, 60))
def test_segments_may_begin_wherever_all_of_them_lies_in_one_log(rows, ticks):
    fitting = [count for count in rows if count >= ticks + MAX_DELAY + 1]
    logs = [numbered(count, i) for i, count in enumerate(rows)]
    if not fitting:
        with pytest.raises(LogError, match=f"{max(rows)} rows; .* {ticks + MAX_DELAY + 1} "):
            Table.of(logs, ticks)
        return
    table = Table.of(logs, ticks)
    assert table.starts.size == sum(count - ticks - MAX_DELAY for count in fitting)
    column = np.asarray(table.motion.angle)
    starts = np.asarray(table.starts)
    first = column[starts - MAX_DELAY]
    last = column[starts + ticks]
    np.testing.assert_array_equal(last - first, MAX_DELAY + ticks)


def test_a_segment_holds_commands_and_what_the_row_behind_each_shows_of_them():
    segment = Table.of([numbered(80, 0), numbered(90, 1)], ticks=10).draw(jax.random.key(0), 16, 10)
    at = np.asarray(segment.motion.angle[:, 0])
    assert len(set(at)) > 8
    np.testing.assert_array_equal(segment.commands.angle, at[:, None] + np.arange(10))
    np.testing.assert_array_equal(segment.motion.velocity, at[:, None] + np.arange(11))
    np.testing.assert_array_equal(segment.force[..., 1], at[:, None] + np.arange(1, 11))
    np.testing.assert_array_equal(
        segment.waiting.velocity, at[:, None] - np.arange(1, MAX_DELAY + 1)
    )


def test_scales_are_the_spreads_of_the_logs_and_no_change_reaches_over_their_ends():
    logs = [small.recorded(300, seed=seed) for seed in range(3)]
    scales = measure_scales(logs)
    force = np.concatenate([log.reading.force for log in logs])
    assert scales.angle_rad == pytest.approx(
        np.concatenate([log.reading.angle for log in logs]).std(), rel=1e-5
    )
    assert scales.force_n == pytest.approx(np.sqrt(np.mean(force**2)), rel=1e-5)
    shifted = [
        log._replace(reading=log.reading._replace(velocity=log.reading.velocity + i))
        for i, log in enumerate(logs)
    ]
    assert measure_scales(shifted).change_rad_s == pytest.approx(scales.change_rad_s, rel=1e-4)


@pytest.mark.parametrize("column", ["angle", "velocity", "force"])
def test_a_column_that_never_changes_is_named(column):
    log = small.recorded(100)
    still = log.reading._replace(**{column: np.zeros_like(getattr(log.reading, column))})
    with pytest.raises(LogError, match=f"{column} never changes in the training logs"):
        measure_scales([log._replace(reading=still)])
