"""The force sensor's zero: set it, verify it, and detect later whether it was lost.

A sensor that keeps its zero loses it when it loses power. Its sample counter reveals that:
`zero_force` saves the counter in the rig's record, and it is compared each time the rig is opened.
"""

import datetime

from softfin.core.errors import DeviceError, RigError
from softfin.core.json_object import JsonObject
from softfin.gaits.reachable import round_size
from softfin.rig.config import RigConfig
from softfin.rig.device import ForceSensor, drop_address
from softfin.rig.record import ForceZero, load_record, save_record
from softfin.rig.safety import FORCE_PEAK_N

MOVING_N = 0.3
"""Standard deviation of the force above which the fin counts as moving [N], times
`tolerance_scale`."""

ZERO_N = 0.1
"""Largest mean force after zeroing, in addition to its noise [N], times `tolerance_scale`."""

ATTEMPTS = 3
"""Number of requests to set the zero; each is a single unacknowledged datagram that may be lost."""

CLOCK_ERROR = 0.02
"""Relative error of the time derived from the sensor's counter, because its rate is measured over
half a second only."""

CLOCK_ERROR_S = 2.0
"""Absolute error of the wall clock [s]."""

MAX_DATE_LAG_S = 3600.0
"""Longest time by which the wall clock may be behind [s]. Beyond that, a counter that wrapped
around cannot be distinguished from a restart."""


def zero_force(sensor: ForceSensor, config: RigConfig, seconds: float = 2.0) -> JsonObject:
    """Set the sensor's zero to the force at rest and save it in the rig's record; raises
    DeviceError if that fails.

    Mean and noise are measured over `seconds`, before and after.
    """
    scale = tolerance_scale(config)
    moving_n = MOVING_N * scale
    zero_n = ZERO_N * scale
    before, deviation = sensor.measured(seconds)
    worst = max(deviation[:3])
    if worst > moving_n:
        raise DeviceError(
            f"force varies by {worst:.2f} N, but at most {moving_n:g} N is allowed; wait until "
            "the water is calm"
        )
    for _ in range(ATTEMPTS):
        sensor.zero()
        after, noise = sensor.measured(seconds)
        is_zero = all(
            abs(force) < zero_n + deviation
            for force, deviation in zip(after[:3], noise[:3], strict=True)
        )
        if is_zero:
            break
    else:
        force = ", ".join(f"{value:+.2f}" for value in after[:3])
        raise DeviceError(
            f"force is still ({force}) N after zeroing {ATTEMPTS} times: each axis must be within "
            f"{zero_n:g} N plus its noise; wait until the water is calm, check the sensor's "
            "network, and make sure that no other program uses the sensor"
        )
    counter = sensor.sample_counter
    zero = ForceZero(
        date=datetime.datetime.fromtimestamp(sensor.clock.wall(), datetime.UTC).isoformat(
            timespec="seconds"
        ),
        sensor_serial=sensor.serial,
        ft_sequence=None if counter is None else counter.samples,
        wall_s=sensor.clock.wall(),
        wrench=sensor.zero_wrench,
        sensor=_settings(sensor),
    )
    record = load_record(config.file)
    save_record(config.file, record.model_copy(update={"force_zero": zero}))
    results = {"force_before_n": before, "force_after_n": after, "noise_n": noise}
    return {name: [round(value, 4) for value in values[:3]] for name, values in results.items()}


def tolerance_scale(config: RigConfig) -> float:
    """Return the factor by which tolerances of the force at rest exceed those for the paper's fin.

    The zero matters for the safety limits, because each log and each run also subtracts its own
    force at rest. So a large fin, whose `safety.force_peak_n` is large, may rest in rougher water.
    For a small fin the tolerances stay the same, because the sensor's noise does.
    """
    return max(round_size(config.safety.force_peak_n / FORCE_PEAK_N), 1.0)


def check_force_zero(sensor: ForceSensor, config: RigConfig) -> ForceZero | None:
    """Return the recorded zero, or None if there is none; raises RigError if the open sensor has
    lost it or has other settings."""
    zero = load_record(config.file).force_zero
    if zero is None:
        return None
    fix = "let the fin rest in the water and run: softfin rig zero --force"
    if zero.sensor_serial != sensor.serial:
        raise RigError(
            f"{sensor.name}: has serial number {sensor.serial}, but the "
            f"sensor that was zeroed has {zero.sensor_serial}; connect that sensor, or {fix}"
        )
    if (zero.wrench is None) != (sensor.zero_wrench is None):
        raise RigError(f"{sensor.name}: the zero was set with another type of sensor; {fix}")
    now = _settings(sensor)
    before = now if zero.sensor is None else zero.sensor
    if changes := [
        f"{name} was {before.get(name)} and is {now.get(name)}"
        for name in sorted(before | now)
        if before.get(name) != now.get(name)
    ]:
        raise RigError(
            f"{sensor.name}: its settings have changed since its zero was set "
            f"({', '.join(changes)}); {fix}"
        )
    if zero.wrench is not None:
        sensor.restore_zero(zero.wrench)
    counter = sensor.sample_counter
    if counter is None or zero.ft_sequence is None:
        return zero
    # An emulated rig is paused between commands, and so is its sensor's counter.
    elapsed_s = 0.0 if config.emulation is not None else sensor.clock.wall() - zero.wall_s
    if has_restarted(zero, counter.samples, elapsed_s, counter.rate_hz):
        raise RigError(
            f"{sensor.name}: restarted since its zero was set "
            f"({zero.date}), so its zero is lost; {fix} (also if this computer's date was wrong)"
        )
    return zero


def _settings(sensor: ForceSensor) -> JsonObject:
    """Return the sensor's configuration, on which its zero depends, without its address."""
    return drop_address(sensor.config.model_dump(mode="json"))


def has_restarted(zero: ForceZero, ft_sequence: int, elapsed_s: float, ft_rate_hz: float) -> bool:
    """Return whether the sensor has counted fewer samples than expected since its zero was set.

    The counter wraps around at 2^32, after 6 days at 7.8 kHz. More samples than expected mean that
    the wall clock was wrong, not that the sensor restarted.
    """
    assert zero.ft_sequence is not None, "only a sensor with a counter can be checked"
    expected = zero.ft_sequence + ft_rate_hz * elapsed_s
    # Close to 2^32, `missing` stands for a negative number: more samples than expected.
    missing = (expected - ft_sequence) % 2**32
    tolerance = ft_rate_hz * (CLOCK_ERROR * abs(elapsed_s) + CLOCK_ERROR_S)
    return tolerance < missing < 2**32 - ft_rate_hz * MAX_DATE_LAG_S
