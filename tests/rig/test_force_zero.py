import json
import math

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.axia80 import sensor_pages
from softfin.rig import force_zero
from softfin.rig.check import check_rig
from softfin.rig.config import RigConfig
from softfin.rig.devices.axia80.pages import SETTINGS
from softfin.rig.record import load_record, record_file
from softfin.rig.rig import Rig, zero_force
from tests.rig.rigs import config_of, simulated


@pytest.fixture
def bench(tmp_path):
    """An emulated rig under a load of 5 N, its configuration with a file, and its clock."""
    with simulated() as behind:
        behind.fin.now = lambda now=behind.fin.now: now()._replace(
            wrench=(5.0, 1.0, 0.0, 0.0, 0.0, 0.0)
        )
        config: RigConfig = config_of(behind)
        config._file = tmp_path / "rig.yaml"
        yield behind, config


def test_the_zero_is_the_force_at_rest_which_is_then_zero(bench):
    behind, config = bench
    results = zero_force(Rig(config, behind.clock), 0.2)
    assert results["force_before_n"] == pytest.approx([5.0, 1.0, 0.0], abs=1e-3)
    assert results["force_after_n"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)


def test_a_force_that_changes_while_it_is_zeroed_is_an_error_and_leaves_no_record(bench):
    behind, config = bench
    rig = Rig(config, behind.clock)
    rig.sensor.open()
    zero = rig.sensor.zero

    def zero_then_load():
        zero()
        behind.fin.now = lambda now=behind.fin.now: now()._replace(wrench=(4.0, 1.0, 0, 0, 0, 0))

    rig.sensor.zero = zero_then_load
    with pytest.raises(DeviceError, match=r"force is \(.*-1\.00, .*\) N after zeroing"):
        force_zero.zero_force(rig.sensor, config, 0.2)
    rig.close()
    assert not record_file(config.file).exists()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_force_that_varies_along_one_axis_alone_is_not_made_the_zero(bench, axis):
    behind, config = bench
    still = behind.fin.now

    def swinging():
        state = still()
        wrench = list(state.wrench)
        wrench[axis] += 5.0 * math.sin(2 * math.pi * behind.clock())
        return state._replace(wrench=tuple(wrench))

    behind.fin.now = swinging
    with pytest.raises(
        DeviceError,
        match=r"force varies by \d\.\d\d N, but at most .*; wait until the water is calm",
    ):
        zero_force(Rig(config, behind.clock), 2.0)
    assert not record_file(config.file).exists()


@pytest.mark.parametrize(("peak_n", "allowed_n"), [(5.0, 0.3), (40.0, 0.3), (300.0, 3.0)])
def test_a_large_fin_may_rest_in_rougher_water(bench, peak_n, allowed_n):
    behind, config = bench
    safety = config.safety.model_copy(update={"force_peak_n": peak_n})
    rough = config.model_copy(update={"safety": safety})
    still = behind.fin.now

    def waves(deviation_n):
        def now():
            force = math.sqrt(2) * deviation_n * math.sin(2 * math.pi * behind.clock())
            return still()._replace(wrench=(force, 0.0, 0.0, 0.0, 0.0, 0.0))

        return now

    behind.fin.now = waves(0.9 * allowed_n)
    zero_force(Rig(rough, behind.clock), 2.0)
    behind.fin.now = waves(1.1 * allowed_n)
    with pytest.raises(DeviceError, match=f"but at most {allowed_n:g} N is allowed"):
        zero_force(Rig(rough, behind.clock), 2.0)


def test_the_zero_is_recorded_beside_the_rigs_file(bench):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    zero = load_record(config.file).force_zero
    assert zero is not None
    assert zero.sensor["serial"] == "FT00000"
    assert sorted(zero.wrench[:2]) == pytest.approx([-1.0, 5.0], abs=1e-3)


def opened(config, clock):
    rig = Rig(config, clock)
    try:
        rig.open()
    finally:
        rig.close()


def test_the_zero_is_kept_when_the_sensor_restarts(bench):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    behind.sensor.reboot(1.0)
    behind.clock._now += 1.0
    rig = Rig(config, behind.clock)
    rig.open()
    try:
        assert rig.sensor.read().wrench[:3] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    finally:
        rig.close()


def test_a_zero_set_in_the_sensor_that_was_since_lost_is_refused_and_leaves_nothing_open(bench):
    behind, config = bench
    page = behind.sensor.pages[SETTINGS]
    ending = b"</netft>"
    behind.sensor.pages[SETTINGS] = page.replace(
        ending, b"<setbias>1;-2;0;0;0;0</setbias>" + ending
    )
    zero_force(Rig(config, behind.clock), 0.2)
    opened(config, behind.clock)
    behind.sensor.pages[SETTINGS] = page.replace(ending, b"<setbias>0;0;0;0;0;0</setbias>" + ending)
    rig = Rig(config, behind.clock)
    with pytest.raises(
        RigError, match=r"own_zero was '1;-2;0;0;0;0' and is '0;0;0;0;0;0'\); let the fin rest"
    ):
        rig.open()
    with pytest.raises(DeviceError, match="not open"):
        rig.sensor.keep_up()
    rig.close()


def test_another_sensor_than_the_one_that_was_zeroed_is_refused(bench):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    behind.sensor.pages.update(sensor_pages(serial="FT31415"))
    with pytest.raises(
        RigError,
        match=r"settings have changed since it was zeroed \(serial was 'FT00000' and is 'FT31415'",
    ):
        opened(config, behind.clock)
    zero_force(Rig(config, behind.clock), 0.2)
    opened(config, behind.clock)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"frame": "x,y"}, "frame was 'y,-x' and is 'x,y'"),
        ({"scale": {"force_x": 2.0, "force_y": 1.0}}, "scale was {} and is {'force_x': 2.0, "),
        (
            {"rate_hz": 300.0, "frame": "x,y"},
            "frame was 'y,-x' and is 'x,y', rate_hz was 320.0 and",
        ),
    ],
)
def test_a_zero_set_with_different_settings_is_refused_and_the_changes_are_listed(
    tmp_path, values, words
):
    with simulated(sensor="lines") as behind:
        config: RigConfig = config_of(behind)
        config._file = tmp_path / "rig.yaml"
        zero_force(Rig(config, behind.clock), 0.2)
        changed = RigConfig.build(behind.values(sensor=behind.values()["sensor"] | values))
        changed._file = config.file
        (row,) = [
            row
            for row in check_rig(Rig(changed, behind.clock), tmp_path, 0.2)
            if row.what == "force zero"
        ]
        assert row.state == "wrong"
        assert f"its settings have changed since it was zeroed ({words}" in row.text
        assert row.text.endswith("run: softfin rig zero --force")
        with pytest.raises(RigError, match="its settings have changed"):
            opened(changed, behind.clock)
        opened(config, behind.clock)
        zero_force(Rig(changed, behind.clock), 0.2)
        opened(changed, behind.clock)


def test_the_check_says_whether_the_zero_was_set_and_kept(bench, tmp_path):
    behind, config = bench

    def finding():
        results = check_rig(Rig(config, behind.clock), tmp_path, 0.2)
        return next(
            (result.state, result.text) for result in results if result.what == "force zero"
        )

    state, text = finding()
    assert (state, text.split(";")[0]) == ("note", "never set by softfin")
    zero_force(Rig(config, behind.clock), 0.2)
    assert finding()[0] == "well"
    behind.sensor.pages.update(sensor_pages(serial="FT31415"))
    assert finding()[0] == "wrong"


def test_a_check_never_changes_the_zero(bench, tmp_path):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    before = record_file(config.file).read_bytes()
    list(check_rig(Rig(config, behind.clock), tmp_path, 0.2))
    assert record_file(config.file).read_bytes() == before


def test_a_damaged_record_is_refused_in_one_line(bench):
    behind, config = bench
    record_file(config.file).write_text(json.dumps({"force_zero": {"date": 3}}))
    with pytest.raises(RigError, match=r"rig\.record\.json: .*remove it") as refused:
        opened(config, behind.clock)
    assert "\n" not in str(refused.value)
