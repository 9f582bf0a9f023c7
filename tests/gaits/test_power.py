"""Maps of a fin whose power is known."""

import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.gaits.figure import map_figure
from softfin.gaits.force_map import MapConfig, find_force_map
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import Cell
from tests.gaits.known import KNOWN
from tests.plants import DrivenFin, StrokeFin

CONFIG = MapConfig(
    box=Cell(low=(0.4, -0.2), high=(0.8, 0.2)),
    spacing_n=0.4,
    survey={"cycles": 2, "pushes": 0, "directions": 8},
    gaits={"cycles": 2, "halvings": 0},
)


def mapped(weight: float) -> ForceMap:
    return find_force_map(DrivenFin(), CONFIG.merged({"gaits": {"power": weight}}, "test"))


def test_gaits_with_a_weight_make_the_same_forces_for_less_power():
    default = mapped(0.0).gaits
    cheap = mapped(1.0).gaits
    for gaits in (default, cheap):
        assert gaits.force_error().max() < 0.02
        assert gaits.power.shape == (2, 2)
    assert (cheap.power < 0.9 * default.power).all()


def test_power_asked_of_a_fin_without_torque_is_refused():
    config = CONFIG.merged({"gaits": {"power": 0.5}}, "test")
    with pytest.raises(
        PlantError, match=r"gaits\.power = 0\.5: this plant does not provide the torq"
    ):
        find_force_map(StrokeFin(), config)


def test_the_figure_and_the_file_show_power_if_it_is_known():
    power = np.full((3, 4), 2.0, np.float32)
    known = KNOWN._replace(gaits=KNOWN.gaits._replace(power=power))
    labels = [axes.get_ylabel() for axes in map_figure(known, 0.1).get_axes()]
    assert [label for label in labels if "W]" in label] == [
        "mechanical power of the gait [W]",
        "force per power [N/W]",
    ]
    np.testing.assert_array_equal(known.arrays()["power_w"], power)
    assert "power_w" not in KNOWN.arrays()
