import jax
import jax.numpy as jnp
import numpy as np
import pytest
from studies.benchmark_rows import FREQUENCY_HZ, AmplitudeLaw, SineTable, Still
from studies.open_loop import ShaftSine, inverse

from softfin.control.controller import Controller, Measured
from softfin.core.errors import CoverageError
from softfin.tank import Tank

LIMITS = Tank().limits
REST = Measured(0.0, jnp.zeros(2))


def commands(controller, reference, ticks):
    state = controller.init()
    angles = []
    for _ in range(ticks):
        state, command = controller.act(state, REST, jnp.asarray(reference))
        angles.append(float(command.angle))
    return angles


def test_the_law_commands_the_sine_of_the_inverse_model():
    reference = np.array([2.0, -1.0])
    sine = inverse(reference, FREQUENCY_HZ, LIMITS, 5.0)
    law = AmplitudeLaw(LIMITS, constant_n_s2=5.0)
    expected = sine.commands(LIMITS, 150).angle
    assert commands(law, reference, 150) == pytest.approx(np.asarray(expected).tolist(), abs=1e-5)


def test_the_law_follows_a_reference_that_changes():
    law = AmplitudeLaw(LIMITS)
    _, one = law.act(jnp.asarray(24), REST, jnp.array([2.0, 1.0]))
    _, other = law.act(jnp.asarray(24), REST, jnp.array([2.0, -1.0]))
    assert other.angle > one.angle


def table():
    references = jnp.array([[1.0, 0.0], [2.0, 1.0]])
    sines = ShaftSine(jnp.array([0.1, 0.2]), jnp.array([0.3, 0.4]), jnp.array([1.0, 2.0]))
    return SineTable(LIMITS, references=references, sines=sines)


def test_the_table_commands_the_sine_of_its_reference():
    expected = ShaftSine(0.2, 0.4, 2.0).commands(LIMITS, 40).angle
    assert commands(table(), (2.0, 1.0), 40) == pytest.approx(np.asarray(expected), abs=1e-5)


def test_the_table_covers_only_its_references():
    table().check((2.0, 1.0))
    with pytest.raises(CoverageError, match=r"reference \(2, 0\) N: the table has no sine for it"):
        table().check((2.0, 0.0))


def test_a_still_fin_stays_at_rest():
    assert set(commands(Still(LIMITS), (2.0, 1.0), 3)) == {0.0}


@pytest.mark.parametrize("row", [Still(LIMITS), AmplitudeLaw(LIMITS), table()])
def test_rows_are_controllers_that_can_be_compiled(row):
    assert isinstance(row, Controller)
    run = jax.jit(lambda controller, force: controller.act(controller.init(), REST, force)[1])
    angle = run(row, jnp.array([1.0, 0.0])).angle
    assert abs(float(angle) - commands(row, (1.0, 0.0), 1)[0]) < 1e-5
