"""Power to the motor and off it again, step by step as the drive reports each; all of it bounded in time."""

from collections.abc import Callable

from softfin.core.errors import DeviceError
from softfin.rig.epos2 import cia402
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import Epos2Config
from softfin.rig.epos2.exchange import Exchange
from softfin.rig.epos2.objects import STATUSWORD
from softfin.rig.epos2.status import ALL

ENABLE_TIMEOUT_S = 1.0
DISABLE_TIMEOUT_S = 0.3
STEP_S = 0.002
"""Pause between two looks at the drive while it is brought from state to state."""
STANDSTILL_RPM = 5
HOME_TOLERANCE_COUNTS = 20
BRAKING_MARGIN = 2
BRAKING_TICKS = 10
REFUSED = 3
"""Orders in a row that the bus does not take, each after its time-out: then no later one is worth a wait."""


def reach_enabled(exchange: Exchange, halts: int) -> None:
    """Bring the drive to operation enabled, as long as nothing was stopped since `halts`; raises DeviceError."""
    status = exchange.status
    for _ in range(round(ENABLE_TIMEOUT_S / STEP_S)):
        exchange.send_heartbeat()
        exchange.sync_and_read(STEP_S)
        with exchange.lock:
            exchange.refuse_halted(halts)
            if fault := status.fault():
                raise DeviceError(f"{fault}; then run: softfin rig check --reset-fault")
            if status.state is State.OPERATION_ENABLED:
                return
            word = cia402.towards_enabled(status.state)
            if word is not None:
                exchange.control(word)
            exchange.lock.wait(STEP_S)
    state = status.state.words if status.state else "in no state of an EPOS2"
    raise DeviceError(f"drive stays {state} and does not enable; look at its supply and its enable input")


def home(exchange: Exchange, config: Epos2Config, halts: int) -> None:
    """Have a drive that is enabled in homing mode take the present position as home; raises DeviceError."""
    status = exchange.status
    with exchange.lock:
        exchange.refuse_halted(halts)
        exchange.control(cia402.START_HOMING)
    attained = 0
    for _ in range(round(ENABLE_TIMEOUT_S / (2 * STEP_S))):
        exchange.send_heartbeat()
        reading = exchange.sync_and_read(STEP_S)
        if reading.new and reading.state is State.OPERATION_ENABLED and status.has(Bit.ERROR):
            break
        near = abs(status.position) <= HOME_TOLERANCE_COUNTS
        attained = attained + 1 if reading.new and status.has(Bit.ACKNOWLEDGED) and near else 0
        # Twice: bit 12 may still stand from an earlier homing.
        if attained >= 2 and (status.has(Bit.REFERENCED) or not config.zero_needed):
            return
        exchange.clock.sleep(STEP_S)
    raise DeviceError("drive did not take its position as home; hold the fin still and try again")


def rest(exchange: Exchange, config: Epos2Config) -> bool:
    """After a quick stop: wait for standstill, take the voltage off; whether the drive confirms that it is off."""
    status = exchange.status

    def is_off() -> bool:
        return bool(status.answered & 1) and status.state in cia402.UNPOWERED

    def stands() -> bool:
        braked = status.state is State.QUICK_STOP_ACTIVE and abs(status.velocity) <= STANDSTILL_RPM
        return is_off() or (braked and status.answered == ALL)

    braking = BRAKING_MARGIN * config.fastest_rad_s / config.quick_stop_rad_s2 + BRAKING_TICKS * config.sync_s
    _repeat(exchange, cia402.QUICK_STOP, stands, braking, config.sync_s)
    _repeat(exchange, cia402.DISABLE_VOLTAGE, is_off, DISABLE_TIMEOUT_S, config.sync_s)
    # Without process data, as of a node that is not operational, the drive can still be asked.
    return is_off() or cia402.decode(exchange.connection.read(STATUSWORD)) in cia402.UNPOWERED


def _repeat(exchange: Exchange, word: int, done: Callable[[], bool], seconds: float, tick: float) -> None:
    """Repeat an order until it is done or the time is over; counted in ticks, so that a stopped clock ends it too."""
    refused = 0
    for _ in range(max(3, round(seconds / tick))):
        exchange.send_heartbeat()
        refused = 0 if exchange.insist(word) else refused + 1
        if refused == REFUSED:
            return
        exchange.sync_and_read(tick)
        if done():
            return
        exchange.clock.sleep(tick / 2)
