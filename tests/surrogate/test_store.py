import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import ArtifactError
from softfin.core.plant import roll
from softfin.core.plant_identity import identity
from softfin.core.quantities import Command
from softfin.storage import artifact as artifacts
from softfin.surrogate import StreamingSurrogate, Surrogate, load_surrogate, save_surrogate
from tests.surrogate import small as paper
from tests.surrogate.streaming import small


@pytest.fixture
def stored(tmp_path):
    save_surrogate(tmp_path / "s", small.surrogate(), None, artifacts.provenance(seed=0))
    return tmp_path / "s"


def edit(folder, change):
    file = folder / "surrogate.json"
    description = json.loads(file.read_text())
    change(description)
    file.write_text(json.dumps(description))


def readings(plant):
    commands = Command(*map(jnp.asarray, small.commands(100)))
    return roll(plant, plant.init(jax.random.key(0)), commands)[1]


def test_a_stored_streaming_surrogate_says_the_same(stored):
    plant = small.surrogate()
    loaded = load_surrogate(stored)
    assert isinstance(loaded, StreamingSurrogate)
    for one, other in zip(readings(plant), readings(loaded), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (loaded.interval, loaded.limits) == (plant.interval, plant.limits)
    assert identity(loaded) == identity(plant)


def test_the_identity_is_that_of_what_was_loaded_whatever_xla_makes_of_it(stored):
    plant = load_surrogate(stored)
    rest = jax.tree.map(lambda x: x * (1 + 2**-23), plant.rest)
    assert identity(eqx.tree_at(lambda own: own.rest, plant, rest)) == identity(plant)
    offset = plant.members.force.offset + 1
    heavier = eqx.tree_at(lambda own: own.members.force.offset, plant, offset)
    assert identity(heavier) != identity(plant)


def test_the_folder_says_what_it_is(stored):
    description = artifacts.load_description(stored, "surrogate")
    assert description["model"] == "streaming"
    assert description["rate_hz"] == 100
    assert description["members"] == 2
    assert description["parameters"] == small.surrogate().parameters()
    assert description["channels"]["in"] == ["command_angle_rad", "command_velocity_rad_s"]


def test_a_surrogate_from_before_there_was_another_kind_is_the_papers(tmp_path):
    save_surrogate(tmp_path / "s", paper.surrogate(), None, {})
    edit(tmp_path / "s", lambda description: description.pop("model"))
    loaded = load_surrogate(tmp_path / "s")
    assert isinstance(loaded, Surrogate)
    assert loaded.model == "paper"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.update(rate_hz=50), "50 Hz"),
        (lambda d: d.update(format=99), "format is '99'"),
        (lambda d: d.update(model="oracle"), "surrogate architecture oracle: unknown"),
        (lambda d: d["channels"]["out"].pop(), r"channels .*'force_y_n'"),
        (lambda d: d["networks"]["force"].update(units=4), r"familiarity\.mean has the shape"),
        (lambda d: d.update(members=3), r"has the shape \(2, .* \(3, "),
        (lambda d: d.update(members="many"), "invalid description of a surrogate"),
        (lambda d: d.pop("scales"), r"invalid description of a surrogate \('scales'\)"),
        (lambda d: d["scales"].update(force_n=-1), "invalid description of a surrogate"),
        (
            lambda d: d["networks"]["drive"].update(profile=False),
            r"networks\.drive: unknown key 'profile'",
        ),
        (lambda d: d["limits"].pop("angle_min_rad"), "invalid description of a surrogate"),
        (lambda d: d["limits"].update(angle_min_rad="low"), "invalid description of a surrogate"),
    ],
)
def test_a_description_that_does_not_fit_is_one_clear_line(stored, change, words):
    edit(stored, change)
    with pytest.raises(ArtifactError, match=words) as error:
        load_surrogate(stored)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name", ["members.force.core.odd_in", "familiarity.mean", "members.drive.profile.delay"]
)
def test_arrays_that_are_missing_or_short_are_named(stored, name):
    _, weights = artifacts.load(stored, "surrogate")
    cut = weights[name][..., :-1]
    for array, held in ((cut, rf"has the shape \({cut.shape[0]},"), (None, "is missing")):
        changed = {key: value for key, value in weights.items() if key != name}
        changed |= {} if array is None else {name: array}
        (stored / artifacts.WEIGHTS).write_bytes(artifacts.encode(changed))
        with pytest.raises(ArtifactError, match=rf"{name} {held}"):
            load_surrogate(stored)
