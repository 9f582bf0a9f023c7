import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.core.errors import ConfigurationError
from softfin.rig.devices.epos2.config import Epos2Config, Units
from tests.rig.devices.epos2.bench import drive_config

units = st.builds(
    lambda lines, gear, direction, zero: Units.of(
        drive_config(
            encoder_lines=lines,
            gear_ratio=gear,
            direction=direction,
            zero_offset_rad=zero,
        )
    ),
    st.integers(16, 5000),
    st.floats(1.0, 1000.0),
    st.sampled_from([1, -1]),
    st.floats(-3.0, 3.0),
)


@given(units, st.floats(-4.0, 4.0))
def test_an_angle_comes_back_from_counts_to_half_a_count(units: Units, angle: float) -> None:
    assert abs(units.angle(units.counts(angle)) - angle) <= 0.5 / units.counts_per_rad + 1e-12


@given(units, st.integers(-(10**6), 10**6))
def test_counts_come_back_from_an_angle_exactly(units: Units, counts: int) -> None:
    assert units.counts(units.angle(counts)) == counts


@given(units, st.integers(-20000, 20000))
def test_rpm_come_back_from_a_velocity_exactly(units: Units, rpm: int) -> None:
    assert units.rpm(units.velocity(rpm)) == abs(rpm)
    assert units.velocity(rpm) * units.direction * rpm >= 0


def test_a_turn_of_the_fin_is_four_edges_of_each_line_times_the_gear() -> None:
    made = Units.of(drive_config(encoder_lines=500, gear_ratio=66.0))
    assert made.counts(2 * math.pi) == 4 * 500 * 66
    assert made.rpm(2 * math.pi) == 60 * 66


@pytest.mark.parametrize(
    "key", ["node", "encoder_lines", "gear_ratio", "acceleration_rad_s2", "quick_stop_rad_s2"]
)
def test_what_must_not_be_guessed_has_no_default(key: str) -> None:
    values = drive_config().model_dump()
    del values[key]
    with pytest.raises(ConfigurationError, match=key):
        Epos2Config.build(values)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"node": 0}, "node"),
        ({"node": 127}, "node 127 leaves no default for host_node; set host_node"),
        ({"host_node": 5}, "node and host_node are both 5"),
        ({"heartbeat_s": 1.1}, "heartbeat_s"),
        ({"following_error_rad": 1.1}, "following_error_rad"),
        ({"angle_min_rad": 2.0}, "angle_min_rad is 2, angle_max_rad is 1.57"),
        ({"slowest_rad_s": 4.0}, "velocity_min_rad_s is 4, velocity_max_rad_s is 3.14"),
        ({"angle_max_rad": 100.0}, "angle_max_rad is 100; the limits of a fin must be finite"),
        ({"gear_ratio": 0.05, "slowest_rad_s": 0.01}, "rounds to 0 rpm"),
        ({"direction": 2}, "direction"),
        ({"quick_stop_rad_s2": 2.0}, r"needs 1.6 s to stop from fastest_rad_s, .* use 6.3"),
    ],
)
def test_a_configuration_that_cannot_be_is_refused_with_the_reason(
    changes: dict[str, float], words: str
) -> None:
    with pytest.raises(ConfigurationError, match=words):
        Epos2Config.build({**drive_config().model_dump(), **changes})


def test_each_node_has_a_host_of_its_own() -> None:
    hosts = [drive_config(node=node).host for node in range(1, 127)]
    assert len(set(hosts)) == 126
    assert all(1 <= host <= 126 for host in hosts)
    assert drive_config(node=127, host_node=1).host == 1
