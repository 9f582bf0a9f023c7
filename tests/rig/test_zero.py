import itertools

import pytest

from softfin.core.errors import DeviceError
from softfin.rig.zero import zero_angle, zero_force
from tests.rig.rigs import emulated


def test_the_force_at_rest_becomes_zero():
    with emulated() as (behind, bench):
        behind.fin.now = lambda now=behind.fin.now: now()._replace(wrench=(0.4, -1.5, 0.2, 0.0, 0.0, 0.0))
        told = zero_force(bench.machine.config, seconds=0.3, clock=behind.clock)
    assert told["force_before_n"] == pytest.approx([0.4, -1.5, 0.2], abs=1e-3)
    assert told["force_after_n"] == pytest.approx([0, 0, 0], abs=1e-3)


def test_a_fin_that_is_moved_is_not_zeroed():
    with emulated() as (behind, bench):
        signs = itertools.cycle((1.0, -1.0))
        behind.fin.now = lambda now=behind.fin.now: now()._replace(wrench=(next(signs), 0.0, 0.0, 0.0, 0.0, 0.0))
        with pytest.raises(DeviceError, match=r"force varies by .* N \(deviation\): at most 0.3 N; let the water rest"):
            zero_force(bench.machine.config, seconds=0.3, clock=behind.clock)


def test_the_angle_where_it_stands_becomes_zero_and_the_fin_does_not_move():
    with emulated() as (behind, bench):
        behind.fin.move(0.3, 100.0)
        told = zero_angle(bench.machine.config, clock=behind.clock)
        assert told["angle_before_rad"] == pytest.approx(0.3, abs=1e-3)
        assert told["angle_after_rad"] == pytest.approx(0.0, abs=1e-3)
        assert behind.fin.now().angle == pytest.approx(0.3)
