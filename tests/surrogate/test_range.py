"""What follows a surrogate into its controllers."""

import json

import numpy as np
import pytest

from softfin.quantities import Command, Log, Reading
from softfin.surrogate import save_surrogate
from softfin.surrogate.range import CHANNELS, UNKNOWN, learnt_from, training_range
from softfin.surrogate.store import load_surrogate
from tests.surrogate import small as paper
from tests.surrogate.streaming import small

RANGE = {name: [-1.0, 2.0] for name in CHANNELS}


def log(scale):
    rows = np.linspace(-1, 2, 30, dtype=np.float32) * scale
    return Log(Command(9 * rows, 9 * rows), Reading(9 * rows, rows, 2 * rows, np.stack([3 * rows, 4 * rows], axis=1)))


def test_the_range_is_the_least_and_greatest_of_each_channel_over_all_logs():
    assert training_range([log(1), log(-2)]) == {
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
    assert found["training_range"]["angle_rad"] == [scaling["angle_rad"][name] for name in ("data_min", "data_max")]
    assert found["training_range"]["velocity_rad_s"] is None
    assert found["fin"] is None
    save_surrogate(tmp_path / "streaming", small.surrogate(), None, {})
    assert learnt_from(tmp_path / "streaming") == UNKNOWN


@pytest.mark.parametrize("plant", ["tank", "package.module:plant", object()])
def test_of_any_other_plant_nothing_is_known(plant):
    assert learnt_from(plant) == UNKNOWN
