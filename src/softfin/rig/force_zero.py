"""The force sensor zero, which softfin subtracts from all readings: measured at rest, saved in
the rig record, and used whenever the rig is opened."""

import datetime

from softfin.core.errors import DeviceError, RigError
from softfin.core.json_object import JsonObject, describe_changes
from softfin.gaits.reachable import round_size
from softfin.rig.config import RigConfig
from softfin.rig.device import drop_address
from softfin.rig.record import ForceZero, load_record, save_record
from softfin.rig.safety import FORCE_PEAK_N
from softfin.rig.streamed_sensor import StreamedSensor

MOVING_N = 0.3
"""Standard deviation of the force above which the fin is treated as moving [N], before scaling by
`tolerance_scale`."""

ZERO_N = 0.1
"""Maximum mean force after zeroing, in addition to the noise [N], before scaling by
`tolerance_scale`."""


def zero_force(sensor: StreamedSensor, config: RigConfig, seconds: float = 2.0) -> JsonObject:
    """Set the sensor zero to the force at rest and save it in the rig record; raises DeviceError on
    failure.

    Mean and noise are measured over `seconds` before and after zeroing.
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
    sensor.zero()
    after, noise = sensor.measured(seconds)
    if any(
        abs(force) >= zero_n + deviation
        for force, deviation in zip(after[:3], noise[:3], strict=True)
    ):
        force = ", ".join(f"{value:+.2f}" for value in after[:3])
        raise DeviceError(
            f"force is ({force}) N after zeroing: each axis must be within {zero_n:g} N plus its "
            "noise; wait until the water is calm"
        )
    date = datetime.datetime.fromtimestamp(sensor.clock.wall(), datetime.UTC)
    zero = ForceZero(
        date=date.isoformat(timespec="seconds"),
        wrench=sensor.zero_wrench,
        sensor=_settings(sensor),
    )
    record = load_record(config.file)
    save_record(config.file, record.model_copy(update={"force_zero": zero}))
    results = {"force_before_n": before, "force_after_n": after, "noise_n": noise}
    return {name: [round(value, 4) for value in values[:3]] for name, values in results.items()}


def tolerance_scale(config: RigConfig) -> float:
    """Return the factor by which tolerances of the force at rest exceed the tolerances for the
    paper's fin.

    The zero affects only the safety limits, because each log and each run also subtracts its own
    force at rest. A large fin, with a large `safety.force_peak_n`, may therefore rest in rougher
    water. For a small fin, the tolerances stay the same because the sensor noise does.
    """
    return max(round_size(config.safety.force_peak_n / FORCE_PEAK_N), 1.0)


def check_force_zero(sensor: StreamedSensor, config: RigConfig) -> ForceZero | None:
    """Make an open sensor use the recorded zero and return it, or None if there is none; raises
    RigError if the zero is from a different sensor or different settings."""
    zero = load_record(config.file).force_zero
    if zero is None:
        return None
    if changes := describe_changes(zero.sensor, _settings(sensor)):
        raise RigError(
            f"{sensor.name}: its settings have changed since it was zeroed ({changes}); let the "
            "fin rest in the water and run: softfin rig zero --force"
        )
    sensor.restore_zero(zero.wrench)
    return zero


def _settings(sensor: StreamedSensor) -> JsonObject:
    """Return the settings on which the sensor zero depends."""
    return drop_address(sensor.config.model_dump(mode="json")) | sensor.identity
