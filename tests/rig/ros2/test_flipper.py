import pytest

from softfin.core.errors import ConfigurationError, RigError
from softfin.rig.machine import Target
from softfin.rig.ros2.config import FlipperConfig
from softfin.rig.ros2.connection import Publisher
from softfin.rig.ros2.plant import SentCommands, define_types, encode_flipper

DEFINITIONS = {
    "own/msg/Flipper": "float32 frequency\nfloat32 amplitude\nfloat32 zero_direction\nstring "
    "name\nbool on\n",
    "own/msg/Flippers": "std_msgs/Header header\nFlipper[] flippers\nFlipper[2] two\nfloat64[] "
    "angles\nfloat64[2] pair",
}


def encoded(**changes):
    config = FlipperConfig.build({"type": "own/msg/Flippers", "definitions": DEFINITIONS} | changes)
    types = define_types(config.definitions)
    return types.deserialize_cdr(encode_flipper(config, types, 0.5), config.type)


def test_fields_are_found_by_their_path_and_sequences_grow():
    constants = {"flippers.2.frequency": 1.5, "flippers.2.name": "left", "flippers.2.on": True}
    ways = {name: f"flippers.2.{name}" for name in ("zero_direction", "amplitude")}
    message = encoded(constants=constants, **ways)
    assert [flipper.zero_direction for flipper in message.flippers] == [0.0, 0.0, 0.5]
    last = message.flippers[2]
    assert (last.frequency, last.amplitude, last.name, last.on) == (1.5, 0.0, "left", True)
    assert message.header.stamp.sec > 0


def test_numbers_in_sequences_and_arrays_are_fields_too():
    message = encoded(zero_direction="angles.1", amplitude="pair.0")
    assert message.angles.tolist() == [0.0, 0.5]
    assert (
        encoded(zero_direction="two.1.zero_direction", amplitude="two.1.amplitude")
        .two[1]
        .zero_direction
        == 0.5
    )


@pytest.mark.parametrize(
    "way",
    [
        "flippers.0.zero",
        "pair.2",
        "flippers.x.amplitude",
        "flippers.0",
        "angles",
        "flippers.0.name",
        "flippers.0.name.1",
        "__class__",
        "flippers.-1.amplitude",
        "",
    ],
)
def test_a_field_that_is_not_there_is_told_before_anything_is_sent(way):
    with pytest.raises(
        RigError, match=r"flipper: own/msg/Flippers cannot be built .* flippers\.2\.amplitude"
    ):
        encoded(zero_direction=way, amplitude="pair.0")


def test_a_constant_that_a_field_cannot_hold_is_told():
    with pytest.raises(RigError, match="own/msg/Flippers cannot be built"):
        encoded(zero_direction="angles.0", amplitude="pair.0", constants={"header.stamp.sec": 1e30})


def test_a_type_that_is_none_is_a_wrong_configuration():
    with pytest.raises(ConfigurationError, match=r"type = 'Flipper'.*/msg/"):
        FlipperConfig.build({"type": "Flipper"})


@pytest.mark.parametrize("text", ["float64", "= 3"])
def test_a_definition_that_is_none_is_told_in_one_line(text):
    with pytest.raises(RigError, match=r"message own/msg/Bad: invalid definition .*\.msg") as error:
        define_types({"own/msg/Bad": text})
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("field", ["Part[] missing", "Part missing", "float65 a", "wstring wide"])
def test_a_field_of_an_unknown_type_is_told_before_anything_is_sent(field):
    definitions = {"own/msg/Bad": f"{field}\nfloat64 zero_direction\nfloat64 amplitude\n"}
    with pytest.raises(
        RigError, match=r"own/msg/Bad cannot be built .*\.msg text of each type"
    ) as error:
        encoded(type="own/msg/Bad", definitions=definitions)
    assert "\n" not in str(error.value)


def test_late_ticks_are_not_made_up_for():
    sent = []
    commands = SentCommands(Publisher(sent.append, lambda: 1), lambda _, angle: angle, 0.05)
    commands.tick(0.0)
    commands.send(Target(1.0, 1.0), 0.0, 0.0)
    for now in (0.04, 0.33, 0.34, 0.36):
        commands.tick(now)
    assert sent == [0.0, 0.33, 0.36]
