"""Power to the motor and off it again, step by step as the drive reports each; all of it bounded in time."""

from collections.abc import Callable

from softfin.core.errors import DeviceError
from softfin.rig.epos2 import protocol
from softfin.rig.epos2.exchange import Exchange
from softfin.rig.epos2.protocol import Bit, State

ENABLE_TIMEOUT_S = 1.0
DISABLE_TIMEOUT_S = 0.3
STEP_S = 0.002
"""Pause between two looks at the drive while it is brought from state to state."""
STANDSTILL_RPM = 5
"""Of the motor."""
HOME_TOLERANCE_COUNTS = 20
BRAKING_MARGIN = 2
BRAKING_TICKS = 10
REFUSED = 3
"""Orders in a row that the bus does not take, each after its time-out: then no later one is worth a wait."""


def reach_enabled(exchange: Exchange, then_arm: bool) -> None:
    """Bring the drive to operation enabled, unless it is stopped meanwhile; raises DeviceError."""
    status = exchange.status
    for _ in range(round(ENABLE_TIMEOUT_S / STEP_S)):
        exchange.send_heartbeat()
        exchange.sync_and_read(STEP_S)
        with exchange.lock:
            if exchange.stopped:
                raise DeviceError("drive was stopped while it was being enabled; enable it again")
            if fault := status.fault():
                raise DeviceError(f"{fault}; then run: softfin rig check --reset-fault")
            if status.state is State.OPERATION_ENABLED:
                exchange.armed = then_arm
                return
            word = protocol.TO_ENABLED.get(status.state)
            if word is not None:
                exchange.connection.send(*exchange.order(word))
            exchange.lock.wait(STEP_S)
    raise DeviceError(f"drive stays {status.words} and does not enable; look at its supply and its enable input")


def home(exchange: Exchange) -> None:
    """Have a drive that is enabled in homing mode take the present position as home; raises DeviceError."""
    status = exchange.status
    with exchange.lock:
        if not exchange.stopped:
            exchange.connection.send(*exchange.order(protocol.START_HOMING))
    attained = 0
    for _ in range(round(ENABLE_TIMEOUT_S / (2 * STEP_S))):
        exchange.send_heartbeat()
        is_new = exchange.sync_and_read(STEP_S).new
        if is_new and status.state is State.OPERATION_ENABLED and status.has(Bit.ERROR):
            break
        near = abs(status.position) <= HOME_TOLERANCE_COUNTS
        attained = attained + 1 if is_new and status.has(Bit.ACKNOWLEDGED) and near else 0
        # Twice: bit 12 may still stand from an earlier homing.
        if attained >= 2 and (status.has(Bit.REFERENCED) or not exchange.config.zero_needed):
            return
        exchange.clock.sleep(STEP_S)
    raise DeviceError("drive did not take its position as home; hold the fin still and try again")


def rest(exchange: Exchange) -> bool:
    """After a quick stop: wait for standstill, take the voltage off; whether the drive confirms that it is off."""
    status, config = exchange.status, exchange.config

    def is_off() -> bool:
        return bool(status.answered & 1) and status.state in protocol.UNPOWERED

    def stands() -> bool:
        braked = status.state is State.QUICK_STOP_ACTIVE and exchange.units.rpm(status.velocity) <= STANDSTILL_RPM
        return is_off() or (braked and status.new)

    def repeat(word: int, done: Callable[[], bool], seconds: float) -> None:
        """Until it is done or the time is over; counted in ticks, so that a stopped clock ends it too."""
        refused = 0
        for _ in range(max(3, round(seconds / config.sync_s))):
            exchange.send_heartbeat()
            refused = 0 if exchange.insist(word) else refused + 1
            if refused == REFUSED:
                return
            exchange.sync_and_read(config.sync_s)
            if done():
                return
            exchange.clock.sleep(config.sync_s / 2)

    braking = BRAKING_MARGIN * config.fastest_rad_s / config.quick_stop_rad_s2 + BRAKING_TICKS * config.sync_s
    repeat(protocol.QUICK_STOP, stands, braking)
    repeat(protocol.DISABLE_VOLTAGE, is_off, DISABLE_TIMEOUT_S)
    # Without process data, as of a node that is not operational, the drive can still be asked.
    return is_off() or protocol.decode(exchange.connection.read(protocol.STATUSWORD)) in protocol.UNPOWERED
