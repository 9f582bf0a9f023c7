"""With NumPy a controller acts as it does within programs of JAX, action for action."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.controller import Artifact, Measured
from softfin.control.feedback import Feedback, FeedbackConfig
from softfin.control.store import load_controller
from softfin.core.errors import RunError
from softfin.core.operations import NUMPY
from tests.control.folders import KINDS, folder_option
from tests.gaits.known import save_known

ACTIONS = 200


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    out = tmp_path_factory.mktemp("controllers")
    return {kind: folder_option(kind, out) for kind in KINDS}


def episode(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Angles, forces, and references that jump and drift over the borders of cells and beyond
    them."""
    numbers = np.random.default_rng(seed)
    references = []
    at = np.array([2.0, 0.0])
    for index in range(ACTIONS):
        if index % 23 == 0:
            at = numbers.uniform((0.3, -1.7), (3.7, 1.7))
        at = at + numbers.uniform(-0.12, 0.12, 2)
        references.append(at)
    asked = np.array(references, np.float32)
    return (
        numbers.uniform(-1.5, 1.5, ACTIONS).astype(np.float32),
        (asked + numbers.normal(size=(ACTIONS, 2))).astype(np.float32),
        asked,
    )


def original(controller: Any, played: tuple[np.ndarray, ...]) -> tuple[np.ndarray, Any]:
    def act(state: Any, now: Any) -> Any:
        angle, force, reference = now
        state, command = controller.act(state, Measured(angle, force), reference)
        return state, (jnp.stack(command), state)

    _, (commands, states) = jax.jit(lambda *now: jax.lax.scan(act, controller.init(), now))(*played)
    return np.asarray(commands), states


def native(controller: Any, played: tuple[np.ndarray, ...]) -> np.ndarray:
    state = controller.init()
    commands = []
    for angle, force, reference in zip(*(part.tolist() for part in played), strict=True):
        state, target = controller.act(state, Measured(angle, tuple(force)), tuple(reference))
        commands.append(target)
    return np.array(commands)


@pytest.mark.parametrize("kind", KINDS)
def test_an_episode_is_the_same_without_jax(kind: str, folders: dict[str, Path]) -> None:
    played = episode(1)
    controller = load_controller(folders[kind])
    commands, states = original(controller, played)
    if controller.kind == "grid":
        # Worth nothing if nothing switched.
        assert (np.diff(states.active_cell) != 0).sum() >= 10
    np.testing.assert_allclose(native(controller, played), commands, atol=1e-5)


@pytest.mark.parametrize("kind", ["single", "grid", "gaits"])
def test_with_the_outer_loop_too(kind: str, folders: dict[str, Path]) -> None:
    config = FeedbackConfig(noise_n=0.02)
    played = episode(2)
    # Long enough at one reference that something is learnt.
    played[2][60:120] = (1.8, 0.3)
    controller = Feedback(load_controller(folders[kind]), config)
    commands, states = original(controller, played)
    assert np.abs(states.mean).max() > 0.1
    np.testing.assert_allclose(native(controller, played), commands, atol=2e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_it_says_what_it_is(kind: str, folders: dict[str, Path]) -> None:
    found = load_controller(folders[kind])
    assert found.artifact.name == kind
    assert found.artifact.description["provenance"]
    assert len(found.artifact.weights_sha256) == 64
    assert len(found.cells) == (6 if kind == "grid" else 1)


def test_origins_are_equal_where_they_say_the_same(folders: dict[str, Path]) -> None:
    single, gaits = (load_controller(folders[kind]).artifact for kind in ("single", "gaits"))
    assert single == load_controller(folders["single"]).artifact
    assert single != gaits
    assert single != dataclasses.replace(single, weights_sha256="0" * 64)


@pytest.mark.parametrize("kind", KINDS)
def test_a_compiled_program_serves_controllers_of_any_origin(
    kind: str, folders: dict[str, Path]
) -> None:
    controller = load_controller(folders[kind])
    other = dataclasses.replace(
        controller, artifact=Artifact("other", fin="blue", description={"seed": 6})
    )
    traces = []

    @jax.jit
    def first_command(controller: Any) -> Any:
        traces.append(controller)
        measured = Measured(jnp.float32(0.1), jnp.zeros(2))
        return controller.act(controller.init(), measured, jnp.ones(2))[1]

    for wrapped in (lambda inner: inner, Feedback):
        traces.clear()
        assert first_command(wrapped(controller)) == first_command(wrapped(other))
        assert len(traces) == 1


def test_a_program_that_returns_a_controller_gives_it_no_other_ones_origin(
    folders: dict[str, Path],
) -> None:
    controller = load_controller(folders["single"])
    other = dataclasses.replace(controller, artifact=Artifact("other"))
    same = jax.jit(lambda controller: controller)
    assert same(controller).artifact == same(other).artifact == Artifact()


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_may_be_acted_on_again(kind: str, folders: dict[str, Path]) -> None:
    controller = load_controller(folders[kind])
    state = controller.init()
    for _ in range(3):
        state, _target = controller.act(state, Measured(0.2, (1.0, 0.0)), (1.0, 0.2))
    first = controller.act(state, Measured(0.1, (1.0, 0.0)), (2.0, 0.3))[1]
    controller.act(state, Measured(-0.7, (1.0, 0.0)), (3.0, -0.3))
    assert controller.act(state, Measured(0.1, (1.0, 0.0)), (2.0, 0.3))[1] == first


@pytest.mark.parametrize("kind", KINDS)
def test_commands_stay_within_the_limits_at_whatever_is_measured(
    kind: str, folders: dict[str, Path]
) -> None:
    controller = Feedback(load_controller(folders[kind]))
    limits = controller.limits
    state = controller.init()
    for number in (0.0, 1e6, -1e6, 1e-30, 3.0, -1e6, 1e6):
        state, target = controller.act(
            state, Measured(number, (number, -number)), (-number, number)
        )
        assert limits.angle_min <= target.angle <= limits.angle_max
        assert limits.velocity_min <= target.velocity <= limits.velocity_max


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf, 1e7])
def test_what_is_no_measurement_is_refused(number: float, folders: dict[str, Path]) -> None:
    controller = load_controller(folders["gaits"])
    for angle, force, reference in (
        (number, (0.0, 0.0), (1.0, 0.0)),
        (0.0, (0.0, number), (1.0, 0.0)),
        (0.0, (0.0, 0.0), (number, 0.0)),
    ):
        with pytest.raises(RunError, match="inputs must be finite"):
            controller.act(controller.init(), Measured(angle, force), reference)


def test_numpy_works_out_one_of_two_choices() -> None:
    assert NUMPY.choose(True, lambda: 1, lambda: pytest.fail("the other one")) == 1


def test_it_knows_what_its_surrogate_learnt_from_and_of_which_fin(tmp_path: Path) -> None:
    learnt = {"angle_rad": [-1.5, 1.5], "force_x_n": [-2, 9]}
    learnt |= dict.fromkeys(("velocity_rad_s", "force_y_n"))
    controller = load_controller(save_known(tmp_path / "g", training_range=learnt, fin="blue"))
    assert controller.artifact.training_range == ((-1.5, 1.5), None, (-2, 9), None)
    assert controller.artifact.fin == "blue"


def test_a_folder_from_before_that_was_written_knows_neither(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    for name in ("controller.json", "weights.safetensors"):
        (tmp_path / name).write_bytes((folders["grid"] / name).read_bytes())
    file = tmp_path / "controller.json"
    described = json.loads(file.read_text())
    for name in ("training_range", "fin"):
        described.pop(name, None)
    file.write_text(json.dumps(described))
    assert load_controller(tmp_path).artifact.training_range is None
    assert load_controller(tmp_path).artifact.fin is None
