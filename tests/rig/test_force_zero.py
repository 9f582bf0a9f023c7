import json
import math

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.axia80 import sensor_pages
from softfin.rig.check import check_rig
from softfin.rig.config import RigConfig
from softfin.rig.devices.axia80.rdt import RdtCommand
from softfin.rig.force_zero import has_restarted
from softfin.rig.record import ForceZero, load_record, record_file
from softfin.rig.rig import Rig, zero_force
from tests.rig.rigs import config_of, simulated

RATE_HZ = 7812.0


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


def losing(behind, count):
    """The network loses so many requests to set the zero."""
    lost = []
    receive = behind.sensor._socket.recvfrom

    def recvfrom(size):
        data, sender = receive(size)
        if data[2:4] == RdtCommand.BIAS.to_bytes(2, "big") and len(lost) < count:
            lost.append(data)
            raise BlockingIOError
        return data, sender

    behind.sensor._socket.recvfrom = recvfrom
    return lost


@pytest.mark.parametrize("count", [0, 1, 2])
def test_a_request_that_is_lost_is_repeated_until_the_force_is_zero(bench, count):
    behind, config = bench
    lost = losing(behind, count)
    results = zero_force(Rig(config, behind.clock), 0.2)
    assert len(lost) == count
    assert results["force_before_n"] == pytest.approx([5.0, 1.0, 0.0], abs=1e-3)
    assert results["force_after_n"] == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)


def test_a_zero_that_is_never_set_is_an_error_and_leaves_no_record(bench):
    behind, config = bench
    losing(behind, 3)
    with pytest.raises(
        DeviceError,
        match=r"force is still \(\+5\.00, \+1\.00, \+0\.00\) N after zeroing 3 times",
    ):
        zero_force(Rig(config, behind.clock), 0.2)
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
    assert zero.sensor_serial == "FT00000"
    assert zero.wall_s == pytest.approx(behind.clock.wall(), abs=1.0)
    assert zero.ft_sequence > 0.5 * RATE_HZ


def opened(config, clock):
    rig = Rig(config, clock)
    try:
        rig.open()
    finally:
        rig.close()


def test_a_rig_that_is_refused_for_its_zero_leaves_nothing_open(bench):
    behind, config = bench
    behind.clock._now += 10.0
    zero_force(Rig(config, behind.clock), 0.2)
    behind.sensor.reboot(1.0)
    behind.clock._now += 1.0
    rig = Rig(config, behind.clock)
    with pytest.raises(RigError, match="its zero is lost"):
        rig.open()
    with pytest.raises(DeviceError, match="not open"):
        rig.sensor.keep_up()
    rig.close()


@pytest.mark.parametrize("pause_s", [0.0, 60.0, 3600.0])
def test_a_zero_that_was_kept_is_no_obstacle(bench, pause_s):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    behind.clock._now += pause_s
    opened(config, behind.clock)


@pytest.mark.parametrize(("before_s", "after_s"), [(10.0, 0.0), (10.0, 60.0), (600.0, 1800.0)])
def test_a_sensor_that_restarted_since_its_zero_was_set_is_refused(bench, before_s, after_s):
    behind, config = bench
    behind.clock._now += before_s
    zero_force(Rig(config, behind.clock), 0.2)
    behind.sensor.reboot(1.0)
    behind.clock._now += 1.0 + after_s
    with pytest.raises(
        RigError, match=r"restarted since .* its zero is lost; .* softfin rig zero --force"
    ) as refused:
        opened(config, behind.clock)
    assert "\n" not in str(refused.value)
    zero_force(Rig(config, behind.clock), 0.2)
    opened(config, behind.clock)


def test_another_sensor_than_the_one_that_was_zeroed_is_refused(bench):
    behind, config = bench
    zero_force(Rig(config, behind.clock), 0.2)
    behind.sensor.pages.update(sensor_pages(("N", "N-m"), (1e6, 1e6), serial="FT31415"))
    with pytest.raises(
        RigError,
        match=r"has serial number FT31415, but the sensor that was zeroed has FT00000; connect that sensor, or",
    ):
        opened(config, behind.clock)
    zero_force(Rig(config, behind.clock), 0.2)
    opened(config, behind.clock)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"frame": "x,y"}, "frame was y,-x and is x,y"),
        ({"scale": {"force_x": 2.0, "force_y": 1.0}}, "scale was {} and is {'force_x': 2.0, "),
        ({"rate_hz": 300.0, "frame": "x,y"}, "frame was y,-x and is x,y, rate_hz was 320.0 and"),
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
        assert f"its settings have changed since its zero was set ({words}" in row.text
        assert row.text.endswith("run: softfin rig zero --force")
        with pytest.raises(RigError, match="its settings have changed"):
            opened(changed, behind.clock)
        opened(config, behind.clock)
        zero_force(Rig(changed, behind.clock), 0.2)
        opened(changed, behind.clock)


def test_a_zero_remains_valid_with_a_new_address_or_a_record_from_an_earlier_version(tmp_path):
    with simulated(sensor="lines") as behind:
        config: RigConfig = config_of(behind)
        config._file = tmp_path / "rig.yaml"
        zero_force(Rig(config, behind.clock), 0.2)
        record = json.loads(record_file(config.file).read_text())
        assert "udp_port" not in record["force_zero"]["sensor"]
        del record["force_zero"]["sensor"]
        record_file(config.file).write_text(json.dumps(record))
        opened(config, behind.clock)


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
    behind.clock._now += 10.0
    behind.sensor.reboot(1.0)
    behind.clock._now += 1.0
    state, text = finding()
    assert state == "wrong"
    assert "its zero is lost" in text


def test_a_check_never_changes_the_zero(bench, tmp_path):
    behind, config = bench
    before = behind.sensor.remembered()["bias"]
    list(check_rig(Rig(config, behind.clock), tmp_path, 0.2))
    assert behind.sensor.remembered()["bias"] == before


def test_an_old_file_that_asks_for_a_zero_at_the_opening_is_refused_with_the_key(bench):
    behind, _ = bench
    values = behind.values()
    values["sensor"]["bias_on_open"] = True
    with pytest.raises(Exception, match="bias_on_open"):
        RigConfig.build(values, "rig.yaml")


def zero_at(count):
    return ForceZero(
        date="2026-11-25", sensor_serial=None, ft_sequence=int(count) % 2**32, wall_s=0.0
    )


DAY_S = 24 * 3600.0


@pytest.mark.parametrize("on_s", [30.0, 3600.0, 3 * DAY_S, 6 * DAY_S, 30 * DAY_S])
@pytest.mark.parametrize("elapsed_s", [5.0, 600.0, DAY_S, 7 * DAY_S])
def test_a_count_that_went_on_is_no_restart_even_if_it_rolled_over(on_s, elapsed_s):
    now = int(RATE_HZ * (on_s + elapsed_s)) % 2**32
    assert not has_restarted(zero_at(RATE_HZ * on_s), now, elapsed_s, RATE_HZ)
    # Nor is one if the date was behind when the zero was set, or is behind now.
    for date_error_s in (-1.0, 1.0, -1800.0):
        assert not has_restarted(zero_at(RATE_HZ * on_s), now, elapsed_s + date_error_s, RATE_HZ)


@pytest.mark.parametrize("on_s", [3600.0, 3 * DAY_S, 5 * DAY_S])
@pytest.mark.parametrize("elapsed_s", [5.0, 600.0, 0.5 * DAY_S])
@pytest.mark.parametrize("part", [0.01, 0.5, 0.99])
def test_a_count_that_began_anew_is_a_restart_whenever_that_was(on_s, elapsed_s, part):
    now = int(RATE_HZ * elapsed_s * part)
    assert has_restarted(zero_at(RATE_HZ * on_s), now, elapsed_s, RATE_HZ)


def test_a_damaged_record_is_refused_in_one_line(bench):
    behind, config = bench
    record_file(config.file).write_text(json.dumps({"force_zero": {"date": 3}}))
    with pytest.raises(RigError, match=r"rig\.record\.json: .*remove it") as refused:
        opened(config, behind.clock)
    assert "\n" not in str(refused.value)
