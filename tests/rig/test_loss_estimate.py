"""Losses in streams whose times are uneven, slow, fast or in bursts."""

import numpy as np
import pytest

from softfin.rig.loss_estimate import CREDIT_RECORDS, LossEstimate

RATE_HZ = 100.0


def count_missing(times):
    """Missing records before each of those at `times` [records]."""
    estimate = LossEstimate(RATE_HZ)
    return [estimate.missing(step / RATE_HZ) for step in np.diff(times).tolist()]


def in_bursts(size, count, speed):
    """Times of records that wait for the last one of their burst."""
    numbers = np.arange(count)
    return (numbers // size * size + size - 1) / speed + 0.01 * (numbers % size)


@pytest.mark.parametrize("speed", [0.92, 1.0, 1.0001, 1.08])
@pytest.mark.parametrize("size", [1, 2, 4])
def test_bursts_and_a_rate_that_is_not_exact_lose_nothing_for_hours(size, speed):
    assert sum(count_missing(in_bursts(size, 200_000, speed))) == 0


@pytest.mark.parametrize("speed", [0.95, 1.0, 1.05])
@pytest.mark.parametrize("size", [1, 2, 4])
def test_lost_records_are_counted_between_bursts(size, speed):
    times = in_bursts(size, 10_000, speed)
    is_kept = np.arange(len(times)) % 50 != 25
    assert sum(count_missing(times[is_kept])) == 200


def test_a_stream_that_starts_within_a_burst_seems_to_lose_its_rest_once():
    assert sum(count_missing(in_bursts(2, 1001, 1.0)[1:])) == 1


def test_jitter_loses_nothing():
    jitter = np.random.default_rng(0).uniform(-0.24, 0.24, 100_000)
    assert sum(count_missing(np.arange(100_000) + jitter)) == 0


def test_credit_after_one_late_record_expires():
    late = np.arange(1000.0)
    late[100:103] = [102.8, 102.9, 102.95]
    numbers = np.arange(1000)
    assert sum(count_missing(late)) == 3
    is_kept = numbers != 103 + 2 * CREDIT_RECORDS
    assert sum(count_missing(late[is_kept])) == 4
