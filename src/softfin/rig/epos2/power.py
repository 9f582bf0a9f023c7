"""Power to the motor and off it again, step by step with the drive's own word for each; all of it bounded in time."""

from collections.abc import Callable

from softfin.core.errors import DeviceError
from softfin.rig.epos2 import cia402
from softfin.rig.epos2.cia402 import Bit, State
from softfin.rig.epos2.config import DriveConfig
from softfin.rig.epos2.exchange import Exchange
from softfin.rig.epos2.objects import STATUSWORD
from softfin.rig.epos2.seen import ALL

ENABLE_TIMEOUT_S = 1.0
DISABLE_TIMEOUT_S = 0.3
STEP_S = 0.002
"""Between two looks at the drive while it is brought from state to state."""
STANDSTILL_RPM = 5
HOME_TOLERANCE_COUNTS = 20
BRAKING_MARGIN = 2
BRAKING_TICKS = 10
REFUSED = 3
"""Orders in a row that the bus does not take, each after its time-out: then no later one is worth a wait."""
RESET_HINT = "then run: softfin rig check --reset-fault"


def reach_enabled(exchange: Exchange, halts: int) -> None:
    """To operation enabled, as long as nothing was stopped since `halts`; raises DeviceError."""
    seen = exchange.seen
    for _ in range(round(ENABLE_TIMEOUT_S / STEP_S)):
        exchange.beat()
        exchange.sync_and_read(STEP_S)
        with exchange.news:
            exchange.refuse_halted(halts)
            if fault := seen.fault():
                raise DeviceError(f"{fault}; {RESET_HINT}")
            if seen.state is State.OPERATION_ENABLED:
                return
            word = cia402.towards_enabled(seen.state)
            if word is not None:
                exchange.control(word)
            exchange.news.wait(STEP_S)
    state = seen.state.words if seen.state else "in no state of an EPOS2"
    raise DeviceError(f"drive stays {state} and does not enable; look at its supply and its enable input")


def home(exchange: Exchange, config: DriveConfig, halts: int) -> None:
    """In homing mode and enabled: take the present position as home; raises DeviceError."""
    seen = exchange.seen
    with exchange.news:
        exchange.refuse_halted(halts)
        exchange.control(cia402.START_HOMING)
    attained = 0
    for _ in range(round(ENABLE_TIMEOUT_S / (2 * STEP_S))):
        exchange.beat()
        reading = exchange.sync_and_read(STEP_S)
        if reading.new and reading.state is State.OPERATION_ENABLED and seen.has(Bit.ERROR):
            break
        near = abs(seen.position) <= HOME_TOLERANCE_COUNTS
        attained = attained + 1 if reading.new and seen.has(Bit.ACKNOWLEDGED) and near else 0
        # Twice: bit 12 may still stand from an earlier homing.
        if attained >= 2 and (seen.has(Bit.REFERENCED) or not config.zero_needed):
            return
        exchange.clock.sleep(STEP_S)
    raise DeviceError("drive did not take its position as home; hold the fin still and try again")


def rest(exchange: Exchange, config: DriveConfig) -> bool:
    """After a quick stop: wait for standstill, take the voltage off; whether the drive says that it is off."""
    seen = exchange.seen

    def off() -> bool:
        return bool(seen.fresh & 1) and seen.state in cia402.UNPOWERED

    def stands() -> bool:
        braked = seen.state is State.QUICK_STOP_ACTIVE and abs(seen.velocity) <= STANDSTILL_RPM
        return off() or (braked and seen.fresh == ALL)

    braking = BRAKING_MARGIN * config.fastest_rad_s / config.quick_stop_rad_s2 + BRAKING_TICKS * config.sync_s
    _until(exchange, stands, cia402.QUICK_STOP, braking, config.sync_s)
    _until(exchange, off, cia402.DISABLE_VOLTAGE, DISABLE_TIMEOUT_S, config.sync_s)
    # Without process data, as of a node that is not operational, the drive can still be asked.
    return off() or cia402.decode(exchange.wire.ask(STATUSWORD)) in cia402.UNPOWERED


def _until(exchange: Exchange, done: Callable[[], bool], word: int, seconds: float, tick: float) -> None:
    """Repeat an order until it is done or the time is over; counted in ticks, so that a stopped clock ends it too."""
    refused = 0
    for _ in range(max(3, round(seconds / tick))):
        exchange.beat()
        refused = 0 if exchange.insist(word) else refused + 1
        if refused == REFUSED:
            return
        exchange.sync_and_read(tick)
        if done():
            return
        exchange.clock.sleep(tick / 2)
