"""What follows a surrogate into its controllers."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from softfin.control.store import load_controller
from softfin.core.quantities import Command, Log, Reading
from softfin.learning.configuration import SINGLE
from softfin.stages.controllers import map_forces, train
from softfin.stages.surrogates import fit
from softfin.storage.dataset import write_dataset
from softfin.surrogate import save_surrogate
from softfin.surrogate.channels import READINGS, UNKNOWN, learnt_from, ranges
from softfin.surrogate.registry import find_architecture
from softfin.surrogate.store import load_surrogate
from tests.control.test_controllers import untrained
from tests.gaits.known import KNOWN
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

RANGE = {name: [-1.0, 2.0] for name in READINGS}


def log(scale):
    rows = np.linspace(-1, 2, 30, dtype=np.float32) * scale
    return Log(
        Command(9 * rows, 9 * rows),
        Reading(9 * rows, rows, 2 * rows, np.stack([3 * rows, 4 * rows], axis=1)),
    )


def test_the_range_is_the_least_and_greatest_of_each_channel_over_all_logs():
    assert ranges([log(1), log(-2)]) == {
        "angle_rad": [-4, 2],
        "velocity_rad_s": [-8, 4],
        "force_x_n": [-12, 6],
        "force_y_n": [-16, 8],
    }


def test_a_surrogate_that_says_is_taken_at_its_word(tmp_path):
    save_surrogate(tmp_path / "s", small.surrogate(), None, {}, training_range=RANGE, fin="blue")
    assert learnt_from(str(tmp_path / "s")) == {"training_range": RANGE, "fin": "blue"}
    load_surrogate(tmp_path / "s")


def test_an_older_one_has_the_range_of_its_scaling_or_none(tmp_path):
    save_surrogate(tmp_path / "paper", paper.surrogate(), None, {})
    found = learnt_from(tmp_path / "paper")
    scaling = json.loads((tmp_path / "paper" / "surrogate.json").read_text())["scaling"]
    assert found["training_range"]["angle_rad"] == [
        scaling["angle_rad"][name] for name in ("data_min", "data_max")
    ]
    assert found["training_range"]["velocity_rad_s"] is None
    assert found["fin"] is None
    save_surrogate(tmp_path / "streaming", small.surrogate(), None, {})
    assert learnt_from(tmp_path / "streaming") == UNKNOWN


@pytest.mark.parametrize("plant", ["tank", "package.module:plant", object()])
def test_of_any_other_plant_nothing_is_known(plant):
    assert learnt_from(plant) == UNKNOWN


def test_the_stages_hand_it_on_from_the_dataset_to_the_controllers(tmp_path, monkeypatch):
    """Nothing is learnt here: fit, training and map are stood in for."""
    logs = [small.recorded(300, seed) for seed in range(4)]
    write_dataset(tmp_path / "dataset", logs[:3], logs[3:], {"fin": "blue, 2 mm"})

    def fit_streaming(logs, config, seed, run_directory, progress):
        run_directory.log()
        return small.surrogate()

    monkeypatch.setattr(
        "softfin.stages.surrogates.find_architecture",
        lambda model: find_architecture(model)._replace(fit=fit_streaming),
    )
    surveyed = SimpleNamespace(reachable=KNOWN.reachable)
    monkeypatch.setattr("softfin.gaits.simulate.survey", lambda *asked: surveyed)
    monkeypatch.setattr("softfin.learning.train.train_policies", lambda *asked: untrained(SINGLE))
    monkeypatch.setattr("softfin.gaits.force_map.find_force_map", lambda *asked: KNOWN)
    surrogate = str(tmp_path / "surrogate")
    fit(tmp_path / "dataset", out=surrogate)
    train(surrogate, out=tmp_path / "policy")
    map_forces(surrogate, out=tmp_path / "gaits")
    expected = ranges(logs[:3])
    for file in (
        "surrogate/surrogate.json",
        "policy/controller.json",
        "gaits/controller.json",
    ):
        described = json.loads((tmp_path / file).read_text())
        assert described["training_range"] == expected, file
        assert described["fin"] == "blue, 2 mm"
    assert load_controller(tmp_path / "gaits").artifact.training_range[0] == tuple(
        expected["angle_rad"] or ()
    )
