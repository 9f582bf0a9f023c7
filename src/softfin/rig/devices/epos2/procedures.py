"""Procedures that identify, check, configure, power up, home and stop a drive. Each procedure ends
within a bounded time.

Limits and settings are written and read back. Nothing is stored permanently; the drive loses these
settings when it is powered down.
"""

from collections.abc import Callable

from softfin.core.errors import DeviceError, RigError
from softfin.rig.device import RefusedError
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.config import Epos2Config, Units
from softfin.rig.devices.epos2.connection import CanConnection
from softfin.rig.devices.epos2.exchange import Exchange
from softfin.rig.devices.epos2.protocol import Bit, Object, State, fault_line
from softfin.rig.drive_safety import Setting, check_no_pause, check_settings, stays_off, try_until
from softfin.rig.safety import OVERSHOOT_RAD

LISTEN_S = 0.3
"""Time for which softfin listens on the bus before it sends anything [s]; a program that drives a
fin sends every 10 to 40 ms."""
ENABLE_TIMEOUT_S = 1.0
DISABLE_TIMEOUT_S = 0.3
STATE_STEP_S = 0.002
"""Polling interval while the drive changes state [s]."""
STANDSTILL_RPM = 5
HOME_TOLERANCE_COUNTS = 20
REFUSED = 3
"""Number of consecutive ineffective controlwords after which SDO is also tried."""
BUS_REFUSES_S = 0.15
"""Time after which a bus that accepts no frames is considered dead, so that later attempts do not
wait [s]. An adapter with a full queue refuses immediately and recovers within a few
milliseconds."""
LOSS_MARGIN_S = 0.3
"""Time in which a drive must fault after `heartbeat_s` without heartbeats, including braking at
standstill [s]."""
NO_REMOTE_REQUEST = 1 << 30
HOME = {
    protocol.HOMING_METHOD: protocol.HOME_HERE,
    protocol.HOME_OFFSET: 0,
    protocol.HOME_POSITION: 0,
}
"""Homing settings that make the current position zero."""


def refuse_others(connection: CanConnection, config: Epos2Config) -> frozenset[int]:
    """Listen before sending anything; raise RigError if a different program uses this drive or our
    node number.

    The drive would mistake the heartbeats of that program for ours and keep moving if this program
    hangs. Return the COB-IDs of all received frames.
    """
    foreign_ids = connection.listen(LISTEN_S)
    if foreign_ids & protocol.host_cob_ids(config.host):
        raise RigError(
            f"{connection.name}: the node number of this program, {config.host}, is in use by "
            "another program or device; set a different drive.host_node in each rig file, or close "
            "the other program"
        )
    if foreign_ids & {
        protocol.SDO_REQUEST + config.node,
        *(pdo + config.node for pdo in protocol.RPDO),
    }:
        raise RigError(
            f"{connection.name}: another program is using drive {config.node}; close it, or "
            "correct drive.node"
        )
    return foreign_ids


def identify_drive(connection: CanConnection) -> None:
    """Raise RigError if the node does not respond."""
    try:
        connection.read(protocol.DEVICE_TYPE)
    except DeviceError:
        raise RigError(
            f"no drive responds as node {connection.node} on {connection.name}; compare drive.node "
            "with the switches on the drive, and check its supply, cable, termination and "
            "bus.bitrate"
        ) from None


def read_fault(connection: CanConnection) -> str | None:
    """Return the fault of the drive, read over SDO; None if the drive is not in fault."""
    if protocol.decode(connection.read(protocol.STATUSWORD)) not in protocol.FAULT_STATES:
        return None
    code = newest_error(connection)
    return fault_line(code) if code else "drive is in fault without an entry in its error history"


def newest_error(connection: CanConnection) -> int:
    """Return the latest error code in the error history of the drive; 0 if the history is empty."""
    if connection.read(protocol.ERROR_COUNT) == 0:
        return 0
    return connection.read(protocol.NEWEST_ERROR) & 0xFFFF


def read_optional(connection: CanConnection, entry: Object) -> int | None:
    """Read an object of the drive; None if the drive does not have the object."""
    try:
        return connection.read(entry)
    except RefusedError as refusal:
        if refusal.code not in protocol.MISSING:
            raise
        return None


def settings(config: Epos2Config) -> tuple[Setting[Object], ...]:
    """Return the settings to check before anything is written."""
    lines = config.encoder_lines
    power_of_ten = "every {} would be wrong by a power of ten; set it to 0"
    return (
        # CiA 402: the lower 16 bits contain the device profile number.
        Setting(
            protocol.DEVICE_TYPE,
            range(402, 1 << 32, 1 << 16),
            "not a CiA 402 drive; correct drive.node, or check the drive",
        ),
        # Not verified: 1 is a brushed DC motor, and 10 and 11 are brushless motors. All accept the
        # same commands.
        Setting(protocol.MOTOR_TYPE, (1, 10, 11), "an unsupported motor type; set it"),
        Setting(
            protocol.ENCODER_LINES,
            (lines,),
            f"lines in the drive, but encoder_lines is {lines} in the rig file, so every angle "
            "would be wrong; correct it there, or",
        ),
        Setting(protocol.POSITION_NOTATION, (0,), power_of_ten.format("angle")),
        Setting(protocol.VELOCITY_NOTATION, (0,), power_of_ten.format("velocity")),
        Setting(protocol.ACCELERATION_NOTATION, (0,), power_of_ten.format("acceleration")),
    )


def check_setup(connection: CanConnection, config: Epos2Config) -> tuple[str, ...]:
    """Raise RigError if the drive is in fault, already enabled, or set up differently from the
    rig file; return one note per object that the drive does not have."""
    if fault := read_fault(connection):
        raise RigError(f"{fault}; then run: softfin rig check --reset-fault")
    word = connection.read(protocol.STATUSWORD)
    state = protocol.decode(word)
    if state not in protocol.UNPOWERED:
        raise RigError(
            f"drive is already {protocol.describe_state(state, word)}; close the program that "
            "controls it, or switch the drive off and on"
        )
    return check_settings(
        settings(config), lambda entry: read_optional(connection, entry), "EPOS Studio"
    )


def set_reactions(connection: CanConnection) -> tuple[str, ...]:
    """Write the settings that stop the fin if softfin dies; return one note per object that the
    drive does not have."""
    notes = []
    for entry, value in protocol.REACTIONS.items():
        try:
            write(connection, entry, value)
        except RefusedError as refusal:
            if refusal.code not in protocol.MISSING:
                raise
            notes.append(
                f"drive has no {entry}; run `softfin rig check --prove --arm` to test whether the "
                "drive stops by itself"
            )
    return tuple(notes)


def set_sync(connection: CanConnection, config: Epos2Config) -> int:
    """Make the drive respond only to the SYNC of this program; return the COB-ID to which it
    actually responds."""
    wanted = protocol.SYNC + config.host
    try:
        connection.write(protocol.SYNC_ID, wanted)
        held = connection.read(protocol.SYNC_ID) & 0x7FF
    except RefusedError:
        # Not verified whether an EPOS2 allows this change; if not, it keeps the shared SYNC of CiA
        # 301.
        held = (read_optional(connection, protocol.SYNC_ID) or protocol.SYNC) & 0x7FF
    if held not in (wanted, protocol.SYNC):
        raise RigError(
            f"drive setting {protocol.SYNC_ID} remained 0x{held:03X}; close other programs, and "
            "switch the drive off and on"
        )
    return held


def configure(connection: CanConnection, config: Epos2Config) -> None:
    """Write limits, profile, mode, heartbeat and PDO mapping; the node must be pre-operational."""
    units = Units.of(config)
    # softfin itself keeps its commands within the range. A stroke to the end of the range may
    # overshoot by a few counts, and a drive that checks its actual position would then fault.
    lowest = units.counts(config.angle_min_rad - OVERSHOOT_RAD)
    highest = units.counts(config.angle_max_rad + OVERSHOOT_RAD)
    # A negative direction swaps the ends.
    ends = sorted((lowest, highest))
    values = {
        protocol.HEARTBEAT_CONSUMER: 0,
        protocol.POSITION_MIN: ends[0],
        protocol.POSITION_MAX: ends[1],
        protocol.FOLLOWING_ERROR: round(config.following_error_rad * units.counts_per_rad),
        protocol.FASTEST: units.rpm(config.fastest_rad_s),
        protocol.PROFILE_VELOCITY: units.rpm(config.slowest_rad_s),
        protocol.ACCELERATION: units.rpm(config.acceleration_rad_s2),
        protocol.DECELERATION: units.rpm(config.acceleration_rad_s2),
        protocol.QUICK_STOP_DECELERATION: units.rpm(config.quick_stop_rad_s2),
        protocol.PROFILE_TYPE: 0,
    }
    if config.current_limit_a is not None:
        # The drive uses mA.
        values[protocol.CURRENT_LIMIT] = round(1000 * config.current_limit_a)
    for entry, value in values.items():
        write(connection, entry, value)
    set_mode(connection, protocol.PROFILE_POSITION)
    # Ten heartbeats per timeout, so that a few lost heartbeats do no harm.
    write(connection, protocol.HEARTBEAT_PRODUCER, round(1000 * config.heartbeat_s / 10))
    for first, pdos, cob_id, transmission in (
        (0x1800, protocol.SENT, protocol.TPDO[0], protocol.ON_SYNC),
        (0x1400, protocol.TAKEN, protocol.RPDO[0], protocol.AT_ONCE),
    ):
        # All four PDOs of each kind, so that PDOs left over from an earlier setup are disabled.
        for place in range(4):
            entries = pdos[place] if place < len(pdos) else ()
            _map(
                connection,
                first + place,
                cob_id + 0x100 * place + config.node,
                entries,
                transmission,
            )


def write(
    connection: CanConnection,
    entry: Object,
    value: int,
    shown: Object | None = None,
    mask: int = -1,
) -> None:
    """Write an object and read it (or `shown`) back; raises RigError if the bits in `mask`
    differ."""
    connection.write(entry, value)
    held = connection.read(shown or entry)
    if (held ^ value) & mask:
        raise RigError(
            f"drive setting {shown or entry} remained {held} after {value} was written; close EPOS "
            "Studio and other programs, or use a value in the rig file that the drive accepts"
        )


def set_mode(connection: CanConnection, mode: int) -> None:
    """Set the mode of operation; raises RigError if the drive does not enter this mode."""
    write(connection, protocol.MODE, mode, shown=protocol.MODE_DISPLAY)


def _map(
    connection: CanConnection,
    number: int,
    cob_id: int,
    entries: tuple[Object, ...],
    transmission: int,
) -> None:
    """Map a PDO: its mapping object is 0x200 above its communication object, and it must be
    disabled while the mapping changes."""

    def set_cob_id(value: int) -> None:
        entry = Object(number, 1, "I", "COB-ID")
        write(connection, entry, value | NO_REMOTE_REQUEST, mask=protocol.INVALID | 0x7FF)

    set_cob_id(cob_id | protocol.INVALID)
    if not entries:
        return
    count = Object(number + 0x200, 0, "B", "mapped objects")
    # CiA 301: set the count to 0, write the entries, then set the count.
    connection.write(count, 0)
    for place, entry in enumerate(entries, 1):
        write(connection, Object(number + 0x200, place, "I", "mapping"), entry.mapping)
    write(connection, count, len(entries))
    write(connection, Object(number, 2, "B", "transmission type"), transmission)
    set_cob_id(cob_id)


def reach_enabled(exchange: Exchange, then_arm: bool, meanwhile: Callable[[], object]) -> None:
    """Bring the drive to operation enabled; raises DeviceError on a timeout, a fault or a stop.

    `meanwhile` is called at each step.
    """
    status = exchange.status
    for _ in range(round(ENABLE_TIMEOUT_S / STATE_STEP_S)):
        meanwhile()
        exchange.send_heartbeat()
        exchange.sync_and_read(STATE_STEP_S)
        with exchange.lock:
            if exchange.stopped:
                raise DeviceError("drive was stopped while it was being enabled; enable it again")
            if fault := status.fault():
                raise DeviceError(f"{fault}; then run: softfin rig check --reset-fault")
            if exchange.trouble is not None:
                raise DeviceError(exchange.trouble)
            if status.state is State.OPERATION_ENABLED:
                exchange.armed = then_arm
                return
            word = protocol.TO_ENABLED.get(status.state)
            if word is not None:
                exchange.connection.send(*exchange.order(word))
            # Every frame on the bus notifies this lock. Waiting only for `stopped` prevents frames
            # from other fins from using up the attempts for this drive.
            exchange.lock.wait_for(lambda: exchange.stopped, STATE_STEP_S)
    raise DeviceError(
        f"drive stays {status.words} and does not enable; check its supply and its enable input"
    )


def home(exchange: Exchange) -> None:
    """Make the current position home, with the drive enabled in homing mode; raises DeviceError if
    the drive refuses."""
    status = exchange.status
    with exchange.lock:
        if not exchange.stopped:
            exchange.connection.send(*exchange.order(protocol.START_HOMING))
    attained = 0
    for _ in range(round(ENABLE_TIMEOUT_S / (2 * STATE_STEP_S))):
        exchange.send_heartbeat()
        is_new = exchange.sync_and_read(STATE_STEP_S).new
        if is_new and status.state is State.OPERATION_ENABLED and status.has(Bit.ERROR):
            break
        near = abs(status.position) <= HOME_TOLERANCE_COUNTS
        attained = attained + 1 if is_new and status.has(Bit.ACKNOWLEDGED) and near else 0
        # Check twice, because bit 12 may still be set from an earlier homing.
        if attained >= 2 and (status.has(Bit.REFERENCED) or not exchange.config.zero_needed):
            return
        exchange.clock.sleep(STATE_STEP_S)
    raise DeviceError("drive did not accept its position as home; hold the fin still and try again")


def rest(exchange: Exchange) -> bool:
    """Wait for standstill after a quick stop, then disable the voltage; return whether the drive
    confirms that the motor is off."""
    status = exchange.status
    config = exchange.config

    def stands() -> bool:
        braked = (
            status.state is State.QUICK_STOP_ACTIVE
            and exchange.units.rpm(status.velocity) <= STANDSTILL_RPM
        )
        return exchange.is_off or (braked and status.new)

    # Twice the braking time from the highest velocity, v / a, plus ten ticks.
    braking = 2 * config.fastest_rad_s / config.quick_stop_rad_s2 + 10 * config.sync_s
    if not _insist_until(exchange, protocol.QUICK_STOP, stands, braking):
        # No controlword got through, and the first one that does must not let the fin coast.
        return False
    _insist_until(exchange, protocol.DISABLE_VOLTAGE, lambda: exchange.is_off, DISABLE_TIMEOUT_S)
    if exchange.is_off:
        return True
    # A node that is not operational sends no process data but still answers SDO requests.
    is_there = exchange.clock() - status.heartbeat_time <= config.heartbeat_s
    if exchange.rest_failed and not is_there:
        return False
    return protocol.decode(exchange.connection.read(protocol.STATUSWORD)) in protocol.UNPOWERED


def _insist_until(exchange: Exchange, word: int, done: Callable[[], bool], seconds: float) -> bool:
    """Repeat a controlword until `done()` returns True or for `seconds`; return False if the bus
    accepts no frames.

    The time is counted in ticks so that the loop ends even if the clock stops. If an earlier stop
    used up its time without success, this stop is brief unless the drive now obeys, so that the
    operator is warned soon.
    """
    sync_s = exchange.config.sync_s
    is_later = exchange.rest_failed
    refused_s = 0.0
    for attempt in range(max(REFUSED, round(seconds / sync_s))):
        is_taken = exchange.obeys_stop if word == protocol.QUICK_STOP else exchange.is_off
        if is_later and attempt >= REFUSED and not exchange.obeys_stop:
            return True
        began = exchange.clock()
        exchange.send_heartbeat()
        # A node may report the operational state and still ignore process data.
        also_by_sdo = not is_taken and (is_later or attempt >= REFUSED)
        is_sent = exchange.insist(word, also_by_sdo)
        exchange.sync_and_read(sync_s)
        if done():
            return True
        spent_s = exchange.clock() - began
        pause_s = max(sync_s - spent_s, sync_s / 2)
        refused_s = 0.0 if is_sent else refused_s + spent_s + pause_s
        if refused_s > (0.0 if is_later else BUS_REFUSES_S):
            return False
        exchange.clock.sleep(pause_s)
    return True


def time_own_stop(exchange: Exchange) -> float:
    """Withhold heartbeats from a powered drive until it faults by itself; return the time to the
    fault [s].

    Raises DeviceError if the drive does not fault in time, or faults for a different reason.
    """
    exchange.send_heartbeat()
    last_heartbeat = exchange.clock()
    longest = exchange.config.heartbeat_s + LOSS_MARGIN_S
    silence = 0.0
    while silence <= longest:
        # SYNC continues as in a run so that only the missing heartbeats can stop the drive. After
        # the fault, the node may no longer be operational or respond to SYNC, so the state is read
        # over SDO.
        exchange.sync_and_read(STATE_STEP_S)
        state = protocol.decode(exchange.connection.read(protocol.STATUSWORD))
        silence = exchange.clock() - last_heartbeat
        if state is State.FAULT:
            code = exchange.status.emergency or newest_error(exchange.connection)
            if code != protocol.HOST_LOST:
                raise DeviceError(f"drive faulted for a different reason: {fault_line(code)}")
            check_no_pause(silence, longest)
            return silence
        exchange.clock.sleep(STATE_STEP_S)
    raise DeviceError(
        f"drive ignores missing heartbeats from softfin: no fault within {longest:.1f} s, so the "
        f"fin would keep moving if softfin died; set {protocol.LOSS_REACTION} to 1 and "
        f"{protocol.FAULT_REACTION} to 2 in EPOS Studio, and do not move the fin until this test "
        "passes"
    )


def switch_off(exchange: Exchange) -> bool:
    """Quick-stop, then disable the voltage, in any state of the drive and node; return whether the
    motor is off.

    Each controlword is sent over SDO and as process data, which takes effect immediately if the
    PDOs have softfin's mapping.
    """
    connection = exchange.connection
    config = exchange.config

    def order(word: int) -> State | None:
        exchange.attempt(*exchange.order(word))
        try:
            connection.write(protocol.CONTROLWORD, word)
            return protocol.decode(connection.read(protocol.STATUSWORD))
        except DeviceError:
            # A stopped node does not answer SDO requests; a pre-operational node does.
            exchange.attempt(protocol.NMT, bytes([protocol.NMT_PRE_OPERATIONAL, config.node]))
            return None

    def brakes() -> bool:
        return order(protocol.QUICK_STOP) not in protocol.UNPOWERED and not stands()

    def stands() -> bool:
        velocity = read_optional(connection, protocol.VELOCITY)
        return velocity is not None and abs(velocity) <= STANDSTILL_RPM

    def until(done: Callable[[], bool], seconds: float) -> bool:
        return try_until(exchange.clock, done, seconds, config.sync_s)

    def is_off() -> bool:
        return protocol.decode(connection.read(protocol.STATUSWORD)) in protocol.UNPOWERED

    # Wait for as long as braking from the highest velocity may take; then disable the voltage even
    # if the motor still turns.
    until(
        lambda: not brakes(), config.fastest_rad_s / config.quick_stop_rad_s2 + 10 * config.sync_s
    )
    if not until(lambda: order(protocol.DISABLE_VOLTAGE) in protocol.UNPOWERED, DISABLE_TIMEOUT_S):
        return False
    return stays_off(exchange.clock, is_off, config.sync_s)
