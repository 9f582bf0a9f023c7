import pytest

from softfin.core.errors import ConfigurationError
from softfin.rig.devices.axia80.config import Axia80Config


@pytest.mark.parametrize("missing", ["address", "frame"])
def test_what_must_not_be_guessed_has_no_default(missing):
    values = {"address": "192.168.1.1", "frame": "x,y"}
    del values[missing]
    with pytest.raises(ConfigurationError, match=missing):
        Axia80Config.build(values)


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
        Axia80Config.build({"address": "192.168.1.1", "frame": "x,y", key: value})


def test_the_defaults_are_those_of_the_sensor_as_it_is_delivered():
    config = Axia80Config.build({"address": "192.168.1.1", "frame": "x,y"})
    assert (config.http_port, config.rdt_port, config.rate_hz, config.cutoff_hz) == (
        80,
        49152,
        1000.0,
        30.0,
    )


@pytest.mark.parametrize(
    ("key", "lowest", "highest", "step"),
    [
        ("http_port", 1, 65535, 1),
        ("rdt_port", 1, 65535, 1),
        ("rate_hz", 200.0, 8000.0, 0.1),
        ("cutoff_hz", 10.0, 40.0, 0.1),
    ],
)
def test_a_number_has_bounds(key, lowest, highest, step):
    values = {"address": "192.168.1.1", "frame": "x,y"}
    for allowed in (lowest, highest):
        assert getattr(Axia80Config.build(values | {key: allowed}), key) == allowed
    for refused in (lowest - step, highest + step):
        with pytest.raises(ConfigurationError, match=key):
            Axia80Config.build(values | {key: refused})
