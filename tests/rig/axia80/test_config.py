import numpy as np
import pytest

from softfin.core.errors import ConfigurationError
from softfin.data.importing.importing import FORCE_FRAMES
from softfin.rig.axia80.config import SensorConfig
from softfin.rig.frame import rotation


@pytest.mark.parametrize("frame", FORCE_FRAMES)
def test_every_frame_is_a_rotation(frame):
    turn = rotation(frame)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3))
    assert np.linalg.det(turn) == pytest.approx(1)


def test_a_frame_says_what_is_x_and_what_is_y_in_the_sensors_axes():
    np.testing.assert_allclose(rotation("y,-x") @ [1.0, 2.0, 3.0], [2.0, -1.0, 3.0])
    np.testing.assert_allclose(rotation("y,x") @ [1.0, 2.0, 3.0], [2.0, 1.0, -3.0])


@pytest.mark.parametrize("missing", ["address", "frame"])
def test_what_must_not_be_guessed_has_no_default(missing):
    values = {"address": "192.168.1.1", "frame": "x,y"}
    del values[missing]
    with pytest.raises(ConfigurationError, match=missing):
        SensorConfig.build(values)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("frame", "x,x", "frame"),
        ("rate_hz", 100, "rate_hz"),
        ("cutoff_hz", 50, "cutoff_hz"),
        ("rdt_prot", 49152, "did you mean 'rdt_port'"),
        ("address", "", "address"),
    ],
)
def test_a_wrong_key_or_value_is_named(key, value, words):
    with pytest.raises(ConfigurationError, match=words):
        SensorConfig.build({"address": "192.168.1.1", "frame": "x,y", key: value})
