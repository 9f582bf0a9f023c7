import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.action_clock import PAPER_CLOCK
from softfin.core.errors import PlantError
from softfin.core.plant import roll
from softfin.core.quantities import Command
from softfin.core.randomness import named_key
from softfin.evaluation.view.footage import film, max_sizes
from softfin.evaluation.view.view import StrokeGaitConfig, stroke_gait
from softfin.tank import Tank, TankConfig
from softfin.tank.fin import FinConfig
from tests.evaluation.view.fins import LENGTH_M, BendingFin, OffsetSensor, beating
from tests.plants import AnalyticFin, PlainFin


def test_the_readings_are_those_of_the_plant_rolled_with_the_same_commands():
    fin = BendingFin()
    footage = beating(fin, 250)
    commands = jax.tree.map(jnp.asarray, footage.command)
    _, reading = roll(fin, fin.init(named_key(0, "test")), commands)
    np.testing.assert_allclose(footage.reading.force, reading.force, atol=1e-4)
    np.testing.assert_allclose(
        footage.average[0], reading.force[: PAPER_CLOCK.window_ticks].mean(axis=0), atol=1e-4
    )
    assert len(footage.average) == 250 - PAPER_CLOCK.window_ticks + 1


def test_a_plant_that_knows_its_shape_is_drawn_in_it():
    footage = beating(BendingFin(), 50)
    assert footage.shape_known
    assert footage.shape.shape == (50, 9, 2)
    lengths = np.linalg.norm(np.diff(footage.shape, axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(lengths, LENGTH_M, rtol=1e-5)


@pytest.mark.parametrize("plant", [AnalyticFin(), PlainFin()])
def test_any_other_plant_is_drawn_straight_at_its_angle(plant):
    footage = beating(plant, 50)
    assert not footage.shape_known
    angle = footage.reading.angle
    length = FinConfig().length_m
    np.testing.assert_allclose(footage.shape[:, 0], 0)
    np.testing.assert_allclose(
        footage.shape[:, 1], length * np.stack([-np.cos(angle), np.sin(angle)], -1), rtol=1e-5
    )


def test_the_tip_of_a_stiff_fin_in_the_tank_is_where_the_shaft_points():
    fin = FinConfig(youngs_modulus_pa=1e10, plates=3)
    tank = Tank(TankConfig(fin=fin))
    commands = stroke_gait(StrokeGaitConfig(centre_rad=0.4), tank.limits, 60)
    footage = film(tank, named_key(0, "test"), commands)
    angle = footage.reading.angle
    assert np.ptp(angle) > 0.2
    pointing = fin.length_m * np.stack([-np.cos(angle), np.sin(angle)], axis=-1)
    np.testing.assert_allclose(footage.shape[:, -1], pointing, atol=2e-3)


def test_a_tank_is_drawn_in_its_own_thickness():
    fin = FinConfig(plates=2, root_thickness_m=0.03, tip_thickness_ratio=0.5)
    np.testing.assert_allclose(
        beating(Tank(TankConfig(fin=fin)), 5).thickness, [0.03, 0.0225, 0.015], rtol=1e-6
    )


def test_another_plant_is_drawn_in_the_default_thickness_in_proportion():
    fin = FinConfig()
    drawn = beating(BendingFin(), 5).thickness
    assert len(drawn) == beating(BendingFin(), 5).shape.shape[1]
    assert drawn[0] == pytest.approx(fin.root_thickness_m * LENGTH_M / fin.length_m, rel=0.02)


def test_a_plant_whose_readings_are_not_finite_is_named():
    with pytest.raises(
        PlantError,
        match=r"AnalyticFin: reading\.force is not finite; run softfin\.testing\.check_plant",
    ):
        beating(AnalyticFin(gain=jnp.nan), 5)


def test_a_true_force_that_is_not_finite_is_named():
    class Unsure(OffsetSensor):
        def true_force(self, state):
            return super().true_force(state) * jnp.nan

    with pytest.raises(PlantError, match=r"Unsure: true_force is not finite"):
        beating(Unsure(), 5)


def test_the_true_force_is_drawn_where_the_plant_knows_it():
    footage = beating(OffsetSensor(), 220)
    truth = beating(BendingFin(), 220)
    np.testing.assert_allclose(
        footage.reading.force - footage.force, np.tile([3.0, 0.0], (220, 1)), atol=1e-5
    )
    np.testing.assert_allclose(footage.force, truth.force, atol=1e-5)
    np.testing.assert_allclose(footage.average, truth.average, atol=1e-5)
    np.testing.assert_allclose(max_sizes(footage), max_sizes(truth), atol=1e-4)
    assert truth.true_force is None
    np.testing.assert_array_equal(truth.force, truth.reading.force)


def test_a_shape_that_is_none_is_named():
    class Flat(BendingFin):
        def shape(self, state):
            return jnp.zeros(3)

    with pytest.raises(
        PlantError, match=r"Flat: shape\(state\) has shape \(3,\); must be \(points, 2\)"
    ):
        film(Flat(), named_key(0, "test"), Command(np.zeros(5, np.float32), np.ones(5, np.float32)))
