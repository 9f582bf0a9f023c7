import numpy as np
import pytest

from softfin.core.errors import LogError
from softfin.core.quantities import Command, Log, Reading
from softfin.tank.calibration.model import cut


def log(rows, shift=0.0):
    """Readings that tell the row they stand in."""
    row = np.arange(rows, dtype=np.float32) + np.float32(shift)
    force = np.stack([row + 0.25, row + 0.5], axis=1)
    return Log(Command(row, np.ones_like(row)), Reading(row / 100, row, row, force))


def test_each_reading_stands_beside_the_command_a_row_before_it():
    segments = cut([log(25)], 2, 10, 3, "training")
    assert segments.measured.shape == (2, 10, 3)
    np.testing.assert_array_equal(segments.measured[..., 0], segments.command.angle + 1)
    np.testing.assert_array_equal(segments.command.angle[1], np.arange(10, 20))
    assert segments.compared.shape == (2, 7, 3)


def test_segments_come_from_all_logs_in_turn_and_end_with_them():
    segments = cut([log(25), log(12, 1000.0), log(8, 2000.0)], 9, 10, 0, "training")
    np.testing.assert_array_equal(segments.command.angle[:, 0], [0, 1000, 10])


def test_logs_too_short_for_a_segment_are_refused():
    with pytest.raises(LogError, match=r"test logs: .* segment_s"):
        cut([log(10)], 2, 10, 0, "test")


def test_a_channel_that_never_changes_is_refused():
    still = log(30)
    still = still._replace(reading=still.reading._replace(force=np.zeros((30, 2), np.float32)))
    with pytest.raises(LogError, match="training logs: force_x"):
        cut([still], 2, 10, 0, "training")
