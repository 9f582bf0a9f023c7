"""Fins whose forces no controller could follow."""

import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.gaits.force_map import MapConfig, find_force_map
from softfin.gaits.reachable import Reachable
from softfin.gaits.simulate import SurveyConfig
from softfin.gaits.usable import check_usable
from tests.plants import NoisyFin, StrokeFin


def region(radius: np.ndarray) -> Reachable:
    return Reachable(np.zeros(2, np.float32), np.asarray(radius, np.float32))


CIRCLE = region(np.full(32, 0.5))


def test_a_fin_without_force_is_refused() -> None:
    with pytest.raises(PlantError, match="no mean force"):
        check_usable(StrokeFin(), region(np.zeros(32)))


@pytest.mark.parametrize("across", [0.0, 1e-5])
def test_a_fin_whose_forces_lie_on_a_line_is_refused(across: float) -> None:
    radius = np.full(32, across)
    radius[[0, 16]] = 2
    with pytest.raises(PlantError, match="on a line"):
        check_usable(StrokeFin(), region(radius))


def test_a_narrow_reach_is_not_a_line() -> None:
    radius = np.full(32, 0.1)
    radius[[0, 16]] = 2
    check_usable(StrokeFin(), region(radius))


def test_a_reach_below_the_noise_is_refused_with_both_and_the_fix() -> None:
    with pytest.raises(PlantError) as refused:
        check_usable(NoisyFin(noise_n=0.6), CIRCLE)
    assert str(refused.value) == (
        "this fin's reach of 0.5 N is below the noise of its mean force, 0.6 N over 2 s (including "
        "drift and the fitting error); use a more sensitive force sensor or faster strokes, record "
        "more logs, or fit longer"
    )


@pytest.mark.parametrize("plant", [NoisyFin(noise_n=0.45), StrokeFin()])
def test_a_reach_above_the_noise_or_an_unknown_noise_is_accepted(plant: StrokeFin) -> None:
    check_usable(plant, CIRCLE)


def test_a_fin_below_its_noise_gets_no_map() -> None:
    notes = []
    quick = MapConfig(survey=SurveyConfig(pushes=0, directions=8))
    with pytest.raises(PlantError, match=r"reach of \S+ N is below the noise of its mean force, 9"):
        find_force_map(NoisyFin(noise_n=9.0), quick, lambda done, note: notes.append(done))
    # The search for gaits takes most of the time and was not started.
    assert max(notes) <= 0.3
