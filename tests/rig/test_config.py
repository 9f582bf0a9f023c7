import pytest
import yaml

from softfin.core.errors import RigError
from softfin.rig.config import load_rig, load_ros2

VALUES = {
    "fin": "blue",
    "bus": {"interface": "socketcan", "channel": "can0"},
    "drive": {
        "node": 1,
        "encoder_lines": 500,
        "gear_ratio": 111.0,
        "acceleration_rad_s2": 80.0,
        "quick_stop_rad_s2": 80.0,
        "following_error_rad": 0.5,
    },
    "sensor": {"address": "192.168.1.1", "frame": "x,y"},
    "safety": {"current_peak_a": 6.0, "current_sustained_a": 3.0},
}


def written(tmp_path, change=lambda values: None):
    values = yaml.safe_load(yaml.safe_dump(VALUES))
    change(values)
    path = tmp_path / "rig.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def test_a_whole_file_is_read(tmp_path):
    assert load_rig(written(tmp_path)).drive.encoder_lines == 500


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda v: v.pop("fin"), "fin"),
        (lambda v: v["drive"].pop("gear_ratio"), "drive.gear_ratio"),
        (lambda v: v["drive"].update(gear_ration=1), "gear_rati"),
        (lambda v: v["sensor"].pop("frame"), "sensor.frame"),
        (lambda v: v["drive"].update(node=200), "drive.node.*200"),
        (
            lambda v: v["safety"].clear(),
            "current_peak_a and current_sustained_a are missing; set them to the peak",
        ),
        (
            lambda v: v["drive"].update(acceleration_rad_s2=300.0),
            "300 exceeds safety.acceleration_rad_s2 = 200",
        ),
        (lambda v: v["safety"].update(force_peek_n=1), "force_pe.k_n"),
    ],
)
def test_a_file_with_a_mistake_is_one_line_that_names_the_key(change, words, tmp_path):
    with pytest.raises(RigError, match=words) as raised:
        load_rig(written(tmp_path, change))
    assert "\n" not in str(raised.value)
    assert "rig.yaml" in str(raised.value)


def test_a_file_that_is_not_there_or_no_yaml_says_what_to_do(tmp_path):
    for load in (load_rig, load_ros2):
        with pytest.raises(
            RigError, match=r"No such file or directory.; copy the example in docs/rig.md"
        ):
            load(tmp_path / "no.yaml")
    bad = tmp_path / "bad.yaml"
    bad.write_text("fin: [")
    with pytest.raises(RigError, match=r"bad.yaml"):
        load_rig(bad)
