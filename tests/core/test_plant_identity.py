import dataclasses
import functools
import os
import subprocess
import sys
import types
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.core.plant_identity import identity
from softfin.core.quantities import PAPER_LIMITS
from softfin.tank import DomainRandomization, RandomizedTank, Tank
from softfin.testing import check_plant
from tests.plants import AnalyticFin, PlainFin


class Own(AnalyticFin):
    """A simulator with a parameter of each kind."""

    factor: float = 1.0
    table: np.ndarray = eqx.field(default_factory=lambda: np.asarray([1.0, 2.0]))
    words: dict[str, int] = eqx.field(default_factory=dict, static=True)
    function: object = eqx.field(default=jnp.tanh, static=True)
    key: jax.Array = eqx.field(default_factory=lambda: jax.random.key(0))


class Line(eqx.Module):
    """A function with a parameter."""

    slope: float = 1.0

    def at(self, x):
        return self.slope * x


class Plain:
    """An object without fields."""

    def at(self, x):
        return x


def scaled(factor):
    """Return a function that appears to be `Line.at`, and depends on the factor."""

    @functools.wraps(Line.at)
    def at(x):
        return factor * x

    return at


class Limited(AnalyticFin):
    """The same fields and other limits."""

    low: float = 1.0

    @property
    def limits(self):
        return PAPER_LIMITS._replace(velocity_min=self.low)


EXAMPLES = (Own(words={"a": 1, "b": 2}), AnalyticFin(), Tank())


def test_an_identity_is_the_same_in_another_process_with_another_seed_of_hashes():
    code = (
        "from tests.core.test_plant_identity import *\n"
        "print([identity(plant) for plant in EXAMPLES])"
    )
    for seed in ("1", "2"):
        out = subprocess.run(
            [sys.executable, "-c", code],
            cwd=Path(__file__).parents[2],
            env=os.environ | {"PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        )
        assert out.stdout.strip() == str([identity(plant) for plant in EXAMPLES])


def test_every_changed_value_type_and_static_field_changes_an_identity():
    different = [
        Own(),
        Own(factor=2.0),
        Own(factor=1),
        Own(gain=2.0),
        Own(lag_s=0.1),
        Own(table=np.asarray([1.0, 3.0])),
        Own(table=np.asarray([1.0, 2.0], np.float32)),
        Own(table=np.asarray([[1.0, 2.0]])),
        Own(words={"a": 1}),
        Own(words={"a": 2}),
        Own(function=jnp.sin),
        Own(key=jax.random.key(1)),
        AnalyticFin(),
        Limited(),
        Tank(),
        RandomizedTank(Tank(), DomainRandomization()),
        RandomizedTank(Tank(), DomainRandomization(temperature_c=0.2)),
    ]
    assert len({identity(plant) for plant in different}) == len(different)


def test_a_method_and_a_partial_function_are_hashed_with_what_they_are_bound_to():
    functions = [
        Line.at,
        Line().at,
        Line(2.0).at,
        {"a": 1}.get,
        {"a": 2}.get,
        functools.partial(jnp.clip, min=1),
        functools.partial(jnp.clip, min=2),
        functools.partial(jnp.clip, 1),
        functools.partial(jnp.sin, 1),
        functools.partial(Line(2.0).at, 1),
        jax.tree_util.Partial(jnp.sin, 1),
    ]
    different = {identity(Own(function=function)) for function in functions}
    assert len(different) == len(functions)
    assert identity(Own(function=Line().at)) == identity(Own(function=Line().at))


def test_equal_values_have_equal_identities():
    assert identity(Own()) == identity(Own())
    assert identity(Own(words={"a": 1, "b": 2})) == identity(Own(words={"b": 2, "a": 1}))
    assert identity(Own(table=jnp.arange(3.0))) == identity(Own(table=np.arange(3, dtype="f4")))


def test_a_constant_of_the_class_that_is_a_limit_is_part_of_a_plant():
    class Narrow(AnalyticFin):
        limits = PAPER_LIMITS

    before = identity(Narrow())
    Narrow.limits = PAPER_LIMITS._replace(velocity_max=3.0)
    assert identity(Narrow()) != before


def test_a_plant_that_is_not_a_pytree_must_state_its_identity():
    fin = PlainFin(2.0)
    assert identity(fin) == "tests.plants.PlainFin gain 2"
    del fin.identity
    with pytest.raises(
        PlantError,
        match=r"PlainFin: not a pytree; make it an equinox.Module, .* add an attribute `identity`",
    ):
        identity(fin)


def test_a_plant_that_is_not_a_pytree_must_be_hashable():
    class Unhashable(PlainFin):
        __hash__ = None

    with pytest.raises(PlantError, match=r"or make it hashable"):
        identity(Unhashable())


@pytest.mark.parametrize(
    "member",
    [
        object(),
        lambda: 1,
        scaled(2.0),
        functools.partial(scaled(2.0)),
        functools.partial(jnp.clip, min=object()),
        Plain().at,
        types.MethodType(scaled(2.0), Line()),
        jax.jit(Line.at),
        dataclasses.make_dataclass("Local", [("x", int, 1)]),
    ],
)
def test_a_member_that_cannot_be_compared_is_named(member):
    with pytest.raises(PlantError, match=r"fields.1.function.* is a .*cannot be compared; make it"):
        identity(Own(function=member))


def test_plants_that_differ_in_arrays_share_a_compiled_program_and_others_do_not():
    traced = []

    @eqx.filter_jit
    def force(plant):
        traced.append(plant)
        return plant.init(jax.random.key(0)).angle

    for plant in (AnalyticFin(), AnalyticFin(gain=2.0), AnalyticFin(lag_s=0.1)):
        force(plant)
    assert len(traced) == 2


def test_the_conformance_kit_asks_for_an_identity():
    fin = PlainFin()
    check_plant(fin)
    del fin.identity
    with pytest.raises(PlantError, match="attribute `identity`"):
        check_plant(fin)
