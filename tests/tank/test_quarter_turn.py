"""The bend of the fin with the greatest thrust lags a quarter turn, as Park et al. (2012) measured
(docs/appendix/tank.md)."""

import runpy

import numpy as np
import pytest

from tests.documents import ROOT

STUDY = runpy.run_path(str(ROOT / "studies/quarter_turn.py"))


@pytest.mark.parametrize("name", ["default", "span 0.040 m", "span 0.160 m"])
def test_the_bend_of_the_fin_with_the_greatest_thrust_lags_about_a_quarter_turn_at_any_frequency(
    name,
):
    best = STUDY["optima"](STUDY["sweep"](STUDY["TANKS"][name]))
    assert ((best.lag_deg > 75) & (best.lag_deg < 120)).all(), best.lag_deg
    assert np.ptp(best.lag_deg) <= 10, best.lag_deg
    # The lag is no constant of the fin: another stiffness is the best at another frequency.
    assert best.stiffness[-1] / best.stiffness[0] > 5
    assert (np.diff(best.stiffness) > 0).all()


def test_the_lag_of_a_known_motion_is_found(monkeypatch):
    """A bend of known phase, in place of the tank's."""
    sweep = STUDY["sweep"]
    frequencies = STUDY["FREQUENCIES_HZ"]
    lags = np.linspace(160, 40, len(STUDY["STIFFNESSES"]))

    def beat(plant, frequency_hz, stiffness):
        times = np.arange(STUDY["TICKS"]) * 0.01
        phase = 2 * np.pi * np.asarray(frequency_hz)[:, None] * times - 0.7
        shaft = 0.4 * np.sin(phase)
        bend = 0.2 * np.sin(
            phase - np.radians(np.tile(lags, len(frequencies)))[:, None]
        ) + 0.1 * np.sin(3 * phase)
        return np.stack([shaft, shaft + bend, np.cos(phase) ** 2], axis=-1)

    monkeypatch.setitem(sweep.__globals__, "beat", beat)
    found = sweep(STUDY["TANKS"]["default"])
    np.testing.assert_allclose(found.lag_deg, np.tile(lags, (len(frequencies), 1)), atol=1e-6)
    np.testing.assert_allclose(found.thrust_n, 0.5, atol=1e-9)
