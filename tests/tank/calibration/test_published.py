from pathlib import Path

import numpy as np
import pytest
from examples.import_keras import read_keras_surrogate

from softfin.core.configuration import read_yaml
from softfin.tank.calibration.calibrate import scores
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.model import cut, material, read, stacked

CONFIG = Path(__file__).parents[3] / "docs" / "calibration.yaml"


@pytest.mark.slow
def test_the_default_tank_does_what_the_published_fin_does_under_commands_it_was_not_fitted_to(
    published,
):
    names = ("cnn_pos_net.keras", "lstm_force_net.keras", "scalers.json")
    fin = read_keras_surrogate(*(published / name for name in names))
    config = CalibrateConfig.build(read_yaml(CONFIG)).merged(
        {"velocity_rad_s": [0.5, 1.57], "segments": 2}, "test"
    )
    _, logs, _ = material(fin, config, seed=11)
    unseen = cut(logs, config.test_segments, 1200, 200, "test")
    row = scores(
        np.asarray(read(stacked([(config.tank, config.recording)]), unseen.command)[0]), unseen
    )
    assert row["angle"]["r2"] > 0.95
    assert row["force_x"]["r2"] > 0.8
    assert row["force_y"]["r2"] > 0.8
