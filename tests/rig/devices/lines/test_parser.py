"""Lines that are cut, doubled or not numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.rig.devices.lines.config import LinesConfig
from softfin.rig.devices.lines.parser import LineCounter, parse_line
from tests.rig.devices.lines.test_config import VALUES


def config(**changes):
    return LinesConfig.build(VALUES | changes)


def test_columns_are_scaled_and_put_in_their_channels():
    columns = ["time_us", "force_y", "skip", "force_x", "torque_z"]
    settings = config(columns=columns, scale={"force_y": -2.0}, separator=";")
    record = parse_line(b" 1234; 1.5; left; -3; 0.25\r", settings)
    assert record.number == 1234
    assert record.wrench.tolist() == [-3.0, -3.0, 0.0, 0.0, 0.0, 0.25]


@pytest.mark.parametrize(
    "line",
    [
        b"1,2.0",
        b"1,2.0,3.0,4.0",
        b"1,2.01,2.0,3.0",
        b"1,2.0,3.01,2.0,3.0",
        b"1,2.0,nan",
        b"1,inf,2.0",
        b"1,2.0,",
        b"1,2.0,x",
        b"1.5,2.0,3.0",
        b"1,2.0,3\xff",
        b"1,1e400,0",
    ],
)
def test_a_line_that_is_cut_joined_or_no_numbers_is_dropped(line):
    assert parse_line(line, config()) is None


@given(st.binary(max_size=60))
def test_no_bytes_raise_an_error_or_give_a_number_that_is_not_finite(line):
    record = parse_line(line, config())
    assert record is None or np.isfinite(record.wrench).all()


def test_lost_doubled_and_late_lines_are_told_apart_even_when_the_counter_wraps():
    counter = LineCounter(config())
    numbers = [2**32 - 2, 2**32 - 1, 0, 0, 3, 2]
    assert [counter.steps(number) for number in numbers] == [1, 1, 1, 0, 3, -1]
    assert not counter.has_restarted


def test_a_counter_that_goes_back_is_a_restart():
    counter = LineCounter(config())
    assert [counter.steps(number) for number in (5000, 1, 2)] == [1, 1, 1]
    assert counter.has_restarted


def test_times_count_lines_by_the_rate_and_late_prints_lose_nothing():
    counter = LineCounter(config(columns=["time_ms", "force_x", "force_y"], rate_hz=100, scale={}))
    assert [counter.steps(number) for number in (1000, 1010, 1012, 1030, 1030)] == [1, 1, 1, 1, 0]
    assert [counter.steps(number) for number in (1040, 1070, 1080)] == [1, 3, 1]


def test_without_a_counter_every_line_is_the_next_one():
    counter = LineCounter(config(columns=["force_x", "force_y"]))
    assert [counter.steps(None) for _ in range(3)] == [1, 1, 1]
