import pytest

from softfin.core.errors import ConfigurationError
from softfin.rig.axia80.config import Axia80Config


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
