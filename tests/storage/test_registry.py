import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from softfin.core.errors import ConfigurationError, PlantError
from softfin.core.plant import hold_action
from softfin.core.quantities import Limits
from softfin.storage.registry import find_plant, is_live, is_surrogate
from softfin.surrogate import Surrogate, load_surrogate, save_surrogate
from softfin.tank import Tank, TankConfig
from softfin.testing import check_plant
from tests.plants import AnalyticFin, PlainFin
from tests.surrogate import small


def test_the_tank_a_surrogate_and_ones_own_simulator_are_found(tmp_path, monkeypatch):
    save_surrogate(tmp_path / "s", small.surrogate(), None, {})
    assert isinstance(find_plant(str(tmp_path / "s")), Surrogate)
    assert isinstance(find_plant("tank"), Tank)
    (tmp_path / "my_simulator.py").write_text(
        "from tests.plants import PlainFin\nplant = PlainFin()\n"
    )
    monkeypatch.chdir(tmp_path)
    assert isinstance(find_plant("my_simulator:plant"), PlainFin)
    assert isinstance(find_plant("my_simulator:PlainFin"), PlainFin)
    sys.modules.pop("my_simulator")


def test_a_tank_of_ones_own_numbers_is_found_by_its_file(tmp_path):
    (tmp_path / "mine.yaml").write_text("fin: {plates: 3}\n")
    assert find_plant(str(tmp_path / "mine.yaml")).fin.stiffness.shape == (3,)
    (tmp_path / "bad.yaml").write_text("fin: {root_thickness_m: -0.01}\n")
    with pytest.raises(ConfigurationError, match=r"bad\.yaml: fin\.root_thickness_m"):
        find_plant(str(tmp_path / "bad.yaml"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("pool", "plant pool: unknown"),
        ("no_such_module:plant", "'no_such_module'"),
        ("json:plant", "'plant'"),
        ("math:pi", "a float is not a plant"),
    ],
)
def test_an_unknown_plant_is_refused_with_the_ways_out(name, words):
    with pytest.raises(PlantError, match=words):
        find_plant(name)


@pytest.mark.parametrize("name", ["tank", "rig", "ros2"])
def test_a_folder_hides_no_plant_and_is_found_by_its_path(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    save_surrogate(tmp_path / name, small.surrogate(), None, {})
    assert is_live(name) is (name != "tank")
    assert not is_surrogate(name)
    if name == "tank":
        assert isinstance(find_plant(name), Tank)
    else:
        with pytest.raises(PlantError, match=rf"real time .* \./{name}$"):
            find_plant(name)
    assert isinstance(find_plant(f"./{name}"), Surrogate)
    assert is_surrogate(f"./{name}")


@pytest.mark.parametrize("load", [find_plant, lambda _: load_surrogate(Path("surrogate"))])
def test_double_precision_is_refused(load):
    with jax.enable_x64(True), pytest.raises(ConfigurationError, match="jax_enable_x64"):
        load("tank")


@pytest.mark.parametrize("thing", [3, None])
def test_an_object_that_is_not_a_plant_is_refused(thing):
    with pytest.raises(PlantError, match=rf"plant: a {type(thing).__name__} is not a plant"):
        find_plant(thing)


def test_a_path_is_a_folder_or_file_and_never_the_name_of_a_plant(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlantError, match="does not exist"):
        find_plant(Path("tank"))
    save_surrogate(Path("tank"), small.surrogate(), None, {})
    assert isinstance(find_plant(Path("tank")), Surrogate)
    assert isinstance(find_plant(tmp_path / "tank"), Surrogate)


def test_a_folder_that_is_no_surrogate_is_no_plant(tmp_path):
    with pytest.raises(PlantError, match=r"contains no surrogate\.json"):
        find_plant(str(tmp_path))


def test_a_simulator_with_limits_that_no_fin_has_is_refused_before_anything_is_trained_in_it(
    tmp_path, monkeypatch
):
    (tmp_path / "my_fast_simulator.py").write_text(
        "from tests.plants import PlainFin\n"
        "class Plant(PlainFin):\n    limits = PlainFin().limits._replace(velocity_max=9000.0)\n"
    )
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlantError, match="my_fast_simulator:Plant: limits: velocity_max_rad_s"):
        find_plant("my_fast_simulator:Plant")
    sys.modules.pop("my_fast_simulator")


def coarse_tank():
    """Of the same parts as the default one; its programs are compiled in half the time."""
    return Tank(TankConfig.build({"fin": {"plates": 2}, "steps_per_tick": 4}))


@pytest.mark.parametrize("plant", [AnalyticFin, PlainFin, coarse_tank])
def test_good_plants_pass_the_conformance_kit(plant):
    check_plant(plant())


class StrictFin(PlainFin):
    """Its readings mean nothing once a command has been beyond its limits."""

    def __init__(self, limits):
        super().__init__()
        self.limits = limits

    def advance(self, state, command, ticks):
        angle_min, angle_max, velocity_min, velocity_max = map(jnp.float32, self.limits)
        is_angle_taken = (angle_min <= command.angle) & (command.angle <= angle_max)
        is_velocity_taken = (velocity_min <= command.velocity) & (command.velocity <= velocity_max)
        state, reading = super().advance(state, command, ticks)
        force = jnp.where(is_angle_taken & is_velocity_taken, reading.force, jnp.nan)
        return state, reading._replace(force=force)


class StrictFinOfItsOwnActions(StrictFin):
    def hold_action(self, state, command, ticks, rows):
        return hold_action(StrictFin(self.limits), state, command, ticks, rows)


@pytest.mark.parametrize(
    "plant",
    [
        StrictFin(Limits(-0.35, 0.35, 1.0, 3.0)),
        StrictFinOfItsOwnActions(Limits(-1.2, 0.4, 0.5, 2.0)),
        StrictFin(Limits(0.0, 0.02, 0.0, 0.2)),
        # In single precision this velocity is 1.2e-6 rad/s higher.
        StrictFin(Limits(-6.28, 0.0, 1.0, 32.06)),
    ],
)
def test_the_conformance_kit_keeps_to_any_plants_own_limits(plant):
    check_plant(plant)


class Broken(PlainFin):
    """A plant with one fault, given as a change of what advance returns."""

    def __init__(self, fault):
        super().__init__()
        self._fault = fault

    def advance(self, state, command, ticks):
        return self._fault(*super().advance(state, command, ticks))


class Forgetful(PlainFin):
    calls = 0

    def advance(self, state, command, ticks):
        self.calls += 1
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(angle=reading.angle + self.calls)


class Backwards(PlainFin):
    limits = Limits(1.0, -1.0, 1.0, 2.0)


class Branching(PlainFin):
    def advance(self, state, command, ticks):
        if command.angle > 0:
            command = command._replace(velocity=command.velocity * 0.9)
        return super().advance(state, command, ticks)


class Telling(PlainFin):
    """A plant that knows its true force, given as a function of its state."""

    def __init__(self, true_force):
        super().__init__()
        self._true_force = true_force

    def init(self, key):
        return {"fin": super().init(key), "force": jnp.zeros(2)}

    def advance(self, state, command, ticks):
        fin, reading = super().advance(state["fin"], command, ticks)
        return {"fin": fin, "force": reading.force[-1]}, reading

    def true_force(self, state):
        return self._true_force(state)


def true_force_of_a_branch(state):
    return state["force"] if state["fin"].angle > 0 else -state["force"]


def test_a_plant_may_know_its_true_force():
    check_plant(Telling(lambda state: state["force"]))


@pytest.mark.parametrize(
    ("plant", "words"),
    [
        (object(), "has no limits, init, advance"),
        (Backwards(), "angle_min < angle_max"),
        (Broken(lambda s, r: (s, r._replace(force=r.force[:, 0]))), r"reading.force .* \(33,\)"),
        (Broken(lambda s, r: (s, r._replace(angle=jnp.float16(r.angle)))), "reading.angle"),
        (Broken(lambda s, r: (s, r._replace(force=r.force / 0))), "reading.force is not finite"),
        (Broken(lambda s, r: (s, r._replace(time=2 * r.time))), "each tick must be 0.01 s"),
        (Broken(lambda s, r: (s._replace(angle=(s.angle, s.angle)), r)), "the same structure"),
        (Broken(lambda s, r: (s, tuple(r))), "advance does not return a Reading"),
        (Forgetful(), "different readings"),
        (Branching(), "no Python branches on values"),
        (Telling(lambda state: state["force"][:1]), r"true_force has shape \(1,\)"),
        (Telling(lambda state: (0.0, 0.0)), "true_force returns a tuple"),
        (Telling(lambda state: state["force"].astype(int)), "true_force is int32"),
        (Telling(lambda state: state["force"] / 0), "true_force is not finite"),
        (Telling(true_force_of_a_branch), "true_force .*no Python branches on values"),
    ],
)
def test_the_conformance_kit_names_the_fault(plant, words):
    with pytest.raises(PlantError, match=words):
        check_plant(plant)


def test_a_simulator_may_import_its_neighbours_when_it_is_built(tmp_path, monkeypatch):
    (tmp_path / "neighbour_of_fin.py").write_text("from tests.plants import PlainFin\n")
    (tmp_path / "lazy_fin.py").write_text(
        "def make():\n    import neighbour_of_fin\n    return neighbour_of_fin.PlainFin()\n"
    )
    monkeypatch.chdir(tmp_path)
    assert isinstance(find_plant("lazy_fin:make"), PlainFin)
    for name in ("lazy_fin", "neighbour_of_fin"):
        sys.modules.pop(name)
