import cmath
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import ActionClock
from softfin.core.quantities import TICK_S, Command, Limits, Reading
from softfin.evaluation.experiment import run
from softfin.evaluation.frequency_response import response, window_response

LAG_S = 0.3
CLOCK = ActionClock(ticks=(1,), window_actions=200)
CENTRE = np.array([2.0, 1.0])
ALONG = np.array([0.8, 0.6])


class LagFin(eqx.Module):
    """A force that follows its command, read as (x, y), with a first-order lag."""

    limits = Limits(-4, 4, 0, 4)

    def init(self, key):
        return jnp.zeros(2)

    def advance(self, force, command, ticks):
        assert ticks == 1
        force = force + (jnp.stack([command.angle, command.velocity]) - force) * TICK_S / LAG_S
        one = jnp.zeros(1)
        return force, Reading(one, one, one, force[None])


class PassOn(eqx.Module):
    """Commands the reference."""

    clock: ActionClock = CLOCK

    def init(self):
        return jnp.int32(0)

    def act(self, state, measured, reference):
        return state, Command(reference[0], reference[1])

    def check(self, reference):
        """Covers everything."""


def turning(rate_hz, ticks):
    turn = 2 * np.pi * rate_hz * np.arange(ticks) * TICK_S
    return CENTRE + 0.5 * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def pulsing(rate_hz, ticks):
    return CENTRE + 0.5 * np.sin(2 * np.pi * rate_hz * np.arange(ticks) * TICK_S)[:, None] * ALONG


def lag(rate_hz):
    """f[k] = f[k - 1] + a (r[k] - f[k - 1]) at a rate."""
    share = TICK_S / LAG_S
    return share / (1 - (1 - share) * cmath.exp(-2j * math.pi * rate_hz * TICK_S))


@pytest.fixture(scope="module")
def rows():
    """Of each rate, when the reference turns and when it pulses."""
    rates = (0.1, 0.4, 0.9)
    cases = [(signal, rate) for signal in (turning, pulsing) for rate in rates]
    tracked = np.stack([signal(rate, 1400) for signal, rate in cases]).astype(np.float32)
    keys = jax.random.split(jax.random.key(0), 1)
    force = np.asarray(run(PassOn(), LagFin(), tracked, 14, keys).force)[:, 0]
    return [
        response(
            force[index],
            tracked[index],
            rate,
            CLOCK.window_ticks,
            4,
            complex(*ALONG) if signal is pulsing else None,
        )
        for index, (signal, rate) in enumerate(cases)
    ]


def test_the_response_of_a_first_order_lag_is_found(rows):
    for row in rows:
        expected = lag(row["rate_hz"])
        assert row["force_gain"] == pytest.approx(abs(expected), abs=2e-3)
        difference = row["force_phase_deg"] - math.degrees(cmath.phase(expected))
        assert difference == pytest.approx(0, abs=0.5)
        assert row["remainder_n"] < 1e-3
    # 1 / sqrt(1 + (2 pi f T)^2)
    assert rows[1]["force_gain"] == pytest.approx(0.80, abs=0.01)


def test_the_gain_of_the_mean_force_includes_the_window(rows):
    for row in rows:
        turn = 2 * math.pi * row["rate_hz"]
        assert row["window_gain"] == pytest.approx(abs(math.sin(turn) / turn), abs=1e-3)
        assert row["gain"] == pytest.approx(row["force_gain"] * row["window_gain"])


def test_only_a_pulse_has_a_part_that_turns_the_other_way(rows):
    assert all(row["counter_gain"] < 1e-3 for row in rows[:3])
    assert all(row["counter_gain"] == pytest.approx(row["gain"], rel=1e-3) for row in rows[3:])


def test_a_rate_that_the_window_averages_out_has_no_force_gain():
    reference = turning(0.5, 1000)
    row = response(reference, reference, 0.5, 200, 0)
    assert row["force_gain"] is row["force_phase_deg"] is None
    assert row["gain"] < 1e-5


def test_a_force_that_equals_its_reference_has_the_response_of_the_window():
    reference = turning(0.2, 1000)
    row = response(reference, reference, 0.2, 200, 0)
    assert row["force_gain"] == pytest.approx(1, abs=1e-4)
    assert row["force_phase_deg"] == pytest.approx(0, abs=1e-2)
    assert cmath.phase(window_response(0.2, 200)) == pytest.approx(-math.pi * 0.2 * 1.99)


def test_ripple_at_other_rates_does_not_count():
    reference = turning(0.2, 2000)
    ripple = np.sin(2 * np.pi * 0.35 * np.arange(2000)[:, None] * TICK_S)
    row = response(reference + ripple, reference, 0.2, 200, 0)
    assert row["force_gain"] == pytest.approx(1, abs=0.05)
    assert row["remainder_n"] > 0.1
