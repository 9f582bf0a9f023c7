"""Which device a rig's file means: softfin's own, or another package's."""

from importlib.metadata import EntryPoint, EntryPoints

import pytest

from softfin.core.errors import ConfigurationError, RigError
from softfin.rig.config import RigConfig
from softfin.rig.device_type import ForceSensorType
from softfin.rig.devices import registry
from softfin.rig.devices.axia80.config import Axia80Config
from softfin.rig.devices.axia80.sensor import AXIA80, RdtSource
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.rig import Rig
from softfin.storage import plugins
from tests.rig.rigs import simulated


@pytest.fixture(scope="module")
def values():
    with simulated() as behind:
        return behind.values()


def test_a_file_without_types_means_the_epos2_and_the_axia80(values):
    unnamed = values | {
        part: {name: value for name, value in values[part].items() if name != "type"}
        for part in ("drive", "sensor")
    }
    config = RigConfig.build(unnamed)
    assert isinstance(config.drive, Epos2Config)
    assert isinstance(config.sensor, Axia80Config)
    assert config == RigConfig.build(values)
    assert RigConfig.build(config.model_dump(mode="json")) == config


@pytest.mark.parametrize(
    ("part", "name", "words"),
    [
        (
            "sensor",
            "axia8",
            r"sensor: type 'axia8': unknown force sensor; use one of axia80, dynamixel, epos2, lines",
        ),
        ("drive", "axia80", "drive: type 'axia80': .* is not a drive; use a different type"),
    ],
)
def test_a_type_that_does_not_exist_or_does_not_fit_is_refused(values, part, name, words):
    with pytest.raises(ConfigurationError, match=words):
        RigConfig.build(values | {part: values[part] | {"type": name}})


def test_keys_of_a_type_are_checked_and_the_nearest_is_suggested(values):
    wrong = values["sensor"] | {"type": "axia80", "rdt_prot": 1}
    with pytest.raises(
        ConfigurationError, match=r"unknown key 'sensor\.rdt_prot'; did you mean 'rdt_port'"
    ):
        RigConfig.build(values | {"sensor": wrong})


def test_a_drive_on_a_bus_needs_one(values):
    with pytest.raises(ConfigurationError, match="bus: missing required key"):
        RigConfig.build({name: value for name, value in values.items() if name != "bus"})


class OtherConfig(Axia80Config):
    type: str = "other"


OTHER = ForceSensorType(OtherConfig, AXIA80.make)


def offer(monkeypatch, value):
    entry = EntryPoint("other", value, registry.GROUP)
    monkeypatch.setattr(plugins, "entry_points", lambda group: EntryPoints((entry,)))


def test_another_package_adds_a_sensor_through_its_entry_point(values, monkeypatch):
    offer(monkeypatch, "tests.rig.devices.test_registry:OTHER")
    config = RigConfig.build(values | {"sensor": values["sensor"] | {"type": "other"}})
    assert isinstance(config.sensor, OtherConfig)
    assert config.model_dump()["sensor"]["type"] == "other"
    assert isinstance(Rig(config).sensor._source, RdtSource)


def test_a_package_that_cannot_be_imported_is_named(monkeypatch):
    offer(monkeypatch, "no_such_package:DEVICE")
    with pytest.raises(RigError, match=r"type 'other': no_such_package:DEVICE cannot be imported"):
        registry.find_device(ForceSensorType, "other")
