import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.core.plant_identity import identity, jit_argument
from softfin.core.quantities import PAPER_LIMITS
from softfin.data.excitation import ExcitationConfig
from softfin.data.simulate import simulate
from softfin.evaluation.experiment import run
from softfin.tank import Tank
from softfin.testing import check_plant
from tests.plants import AnalyticFin, Flapper

GAIN = 1.0


class Own:
    """A user's simulator as plain Python, with a parameter in each place where Python keeps one."""

    limits = PAPER_LIMITS
    scale = 1.0

    def __init__(self, gain=1.0, table=(1.0, 2.0)):
        self.gain = gain
        self.table = np.asarray(table)

    def init(self, key):
        return AnalyticFin().init(key)

    def advance(self, state, command, ticks):
        state, reading = AnalyticFin().advance(state, command, ticks)
        factor = self.gain * self.scale * GAIN * self.table.sum()
        return state, reading._replace(force=(reading.force * factor).astype(jnp.float32))


class WithFloat(AnalyticFin):
    """A pytree with a plain number among its leaves."""

    factor: float = 1.0

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(force=reading.force * self.factor)


class CallingBack(Own):
    """A simulator outside JAX."""

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        shape = jax.ShapeDtypeStruct((ticks, 2), jnp.float32)
        force = jax.pure_callback(self._push, shape, reading.force, vmap_method="sequential")
        return state, reading._replace(force=force)

    def _push(self, force):
        return np.float32(self.gain) * np.asarray(force)


def test_two_plants_that_differ_in_a_plain_number_are_not_the_same():
    assert identity(Own(gain=1.0)) == identity(Own(gain=1.0))
    different = [
        Own(),
        Own(gain=5.0),
        Own(table=(1.0, 3.0)),
        WithFloat(),
        WithFloat(factor=5.0),
        AnalyticFin(lag_s=0.1),
    ]
    assert len({identity(plant) for plant in different}) == len(different)


def test_a_constant_of_the_class_or_of_the_module_is_part_of_a_plant(monkeypatch):
    before = identity(Own())
    monkeypatch.setattr(Own, "scale", 2.0)
    class_changed = identity(Own())
    monkeypatch.undo()
    monkeypatch.setattr(sys.modules[__name__], "GAIN", 2.0)
    assert len({before, class_changed}) == 2
    assert identity(Own()) != before


def test_an_identity_is_the_same_in_another_process():
    code = (
        "from tests.core.test_plant_identity import *\n"
        "print([identity(plant) for plant in (Own(), WithFloat(), AnalyticFin(), Tank())])"
    )
    root = Path(__file__).parents[2]
    out = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    assert out.stdout.strip() == str(
        [identity(plant) for plant in (Own(), WithFloat(), AnalyticFin(), Tank())]
    )


def test_a_plant_that_calls_back_into_python_must_state_its_identity():
    plant = CallingBack()
    with pytest.raises(PlantError, match=r"calls back into Python.*attribute `identity`"):
        identity(plant)
    plant.identity = "gain 1"
    assert identity(plant) == "tests.core.test_plant_identity.CallingBack gain 1"


def test_the_conformance_kit_asks_for_an_identity_and_for_the_same_program_each_time():
    with pytest.raises(PlantError, match="attribute `identity`"):
        check_plant(CallingBack())

    class Counting(Own):
        """Too little for its readings to tell."""

        calls = 0

        def init(self, key):
            Counting.calls += 1
            state = super().init(key)
            return state._replace(angle=state.angle + 1e-7 * self.calls)

    with pytest.raises(
        PlantError, match="Counting: each trace produces a different program; init and advance"
    ):
        check_plant(Counting())


def test_a_plant_that_cannot_be_traced_is_refused_in_one_line():
    class Broken(Own):
        def advance(self, state, command, ticks):
            raise RuntimeError("no\nwater")

    with pytest.raises(
        PlantError,
        match=r"Broken: cannot be traced \(RuntimeError: no water\); run softfin.testing",
    ):
        jit_argument(Broken())


def experiment(plant):
    recording = run(
        Flapper(), plant, np.zeros((1, 2), np.float32), 3, jax.random.split(jax.random.key(0), 1)
    )
    return np.asarray(recording.reading.force)


@pytest.mark.parametrize("kind", [Own, CallingBack])
def test_an_experiment_is_run_on_the_plant_as_it_is_now(kind):
    plant = kind(gain=1.0)
    before = experiment(plant)
    plant.gain = 5.0
    np.testing.assert_allclose(experiment(plant), experiment(kind(gain=5.0)))
    assert np.abs(experiment(plant)).max() > 4 * np.abs(before).max()
    np.testing.assert_allclose(experiment(kind(gain=1.0)), before)


def test_logs_are_recorded_in_the_plant_as_it_is_now():
    def forces(*plants):
        keys = list(jax.random.split(jax.random.key(0), len(plants)))
        logs = simulate(plants, keys, 200, ExcitationConfig(), 2, lambda rows: None)
        return [np.abs(log.reading.force).max() for log in logs]

    plant = Own()
    (before,) = forces(plant)
    plant.gain = 5.0
    assert forces(plant)[0] == pytest.approx(5 * before, rel=1e-5)
    first, second = forces(Own(), Own(gain=5.0))
    assert (first, second > 2 * first) == (pytest.approx(before, rel=1e-5), True)


def test_equal_plants_share_a_compiled_program_and_unequal_ones_do_not():
    traced = []

    @eqx.filter_jit
    def force(plant):
        traced.append(plant)
        return plant.init(jax.random.key(0)).angle

    for plant in (Own(), Own(), Own(gain=5.0), AnalyticFin(gain=1.0), AnalyticFin(gain=2.0)):
        force(jit_argument(plant))
    assert len(traced) == 3
