"""What every drive does to keep a fin safe, apart from talking to its device."""

from collections.abc import Iterator
from contextlib import contextmanager

from softfin.core.errors import RigError, SafetyStop, SoftfinError
from softfin.rig.device import Drive, DriveConfig
from softfin.rig.safety import OVERSHOOT_RAD

UNCONFIRMED = "drive did not confirm that its motor is off; press the emergency stop in its supply"


def check_fin_angle(angle: float, config: DriveConfig) -> None:
    """Raise RigError if the fin's angle [rad] is so far outside its range that its motor must not
    be powered."""
    low = config.angle_min_rad
    high = config.angle_max_rad
    if not low - OVERSHOOT_RAD <= angle <= high + OVERSHOOT_RAD:
        raise RigError(
            f"fin is at {angle:.3f} rad, outside {low:g} .. {high:g}; turn it back by hand, or "
            "turn it to zero and run: softfin rig zero --arm"
        )


@contextmanager
def stopped_afterwards(drive: Drive) -> Iterator[None]:
    """Stop the motor when the block ends, even with an exception; raises SafetyStop if the motor
    may still be on."""
    reason = "the drive was stopped"
    try:
        yield
    except BaseException as error:
        reason = str(error) if isinstance(error, SoftfinError) else "interrupted"
        raise
    finally:
        try:
            drive.stop()
        finally:
            # Once more, in case Ctrl-C interrupted the first stop; this takes no time if the motor
            # is off.
            drive.stop()
            if drive.stop_unconfirmed:
                # This outranks any other error: the operator is next to a powered motor.
                raise SafetyStop(f"{reason}; BUT {drive.stop_unconfirmed}")
