"""Procedures with the drive: identify, check and set it up, power it up, home it, bring it to rest;
bounded in time.

Limits and settings are written and read back; nothing is stored for good: the drive forgets it at
power-down.
"""

import contextlib
from collections.abc import Callable
from typing import NamedTuple

from softfin.core.errors import DeviceError, RigError
from softfin.rig.epos2 import protocol
from softfin.rig.epos2.config import Epos2Config, Units
from softfin.rig.epos2.connection import CanConnection, SdoRefusal
from softfin.rig.epos2.exchange import Exchange
from softfin.rig.epos2.protocol import Bit, Object, State, fault_line
from softfin.rig.safety import OVERSHOOT_RAD

LISTEN_S = 0.3
"""Time for which others are listened to before anything is sent; a program that drives sends every
10 to 40 ms."""
ENABLE_TIMEOUT_S = 1.0
DISABLE_TIMEOUT_S = 0.3
STATE_STEP_S = 0.002
"""Pause between two looks at the drive while it is brought from state to state."""
STANDSTILL_RPM = 5
HOME_TOLERANCE_COUNTS = 20
REFUSED = 3
"""Orders in a row that the drive does not follow, before another way is tried."""
BUS_REFUSES_S = 0.15
"""Time for which the bus takes no order: then no later one is worth a wait. An adapter whose queue
is full refuses at once and recovers within some milliseconds."""
STOP_CONFIRMED_S = 0.3
"""Time for which a motor must stay off; a program that still drives it would enable it within
this."""
LOSS_MARGIN_S = 0.3
"""Time that a drive may take to fault after `heartbeat_s` of silence, with its braking at rest."""
NO_REMOTE_REQUEST = 1 << 30
HOME = {
    protocol.HOMING_METHOD: protocol.HOME_HERE,
    protocol.HOME_OFFSET: 0,
    protocol.HOME_POSITION: 0,
}
"""Homing method that makes the present position zero."""


def refuse_others(connection: CanConnection, config: Epos2Config) -> frozenset[int]:
    """Listen before anything is sent; raise RigError if another program drives this drive or has
    our number.

    Its heartbeats would pass for ours: the drive would then go on although this program hangs.
    Return the COB-IDs of the frames of others.
    """
    foreign_ids = connection.listen(LISTEN_S)
    if foreign_ids & protocol.host_cob_ids(config.host):
        raise RigError(
            f"{connection.name}: node number {config.host} of this program is in use by another "
            "program or device; give each rig's file its own drive.host_node, or end the other "
            "program"
        )
    if foreign_ids & {
        protocol.SDO_REQUEST + config.node,
        *(pdo + config.node for pdo in protocol.RPDO),
    }:
        raise RigError(
            f"{connection.name}: another program talks to drive {config.node}; end it, or correct "
            "drive.node"
        )
    return foreign_ids


def identify_drive(connection: CanConnection) -> None:
    """Raise RigError where the node does not answer."""
    try:
        connection.read(protocol.DEVICE_TYPE)
    except DeviceError:
        raise RigError(
            f"no drive answers as node {connection.node} on {connection.name}; compare drive.node "
            "with the drive's switches, and check supply, cable, termination and bus.bitrate"
        ) from None


def read_fault(connection: CanConnection) -> str | None:
    """The fault that the drive is in, asked for; None when it is in none."""
    if protocol.decode(connection.read(protocol.STATUSWORD)) not in protocol.FAULT_STATES:
        return None
    code = newest_error(connection)
    return fault_line(code) if code else "drive is in fault without an entry in its error history"


def newest_error(connection: CanConnection) -> int:
    """Code of the newest error in the drive's history; 0 if it has none."""
    if connection.read(protocol.ERROR_COUNT) == 0:
        return 0
    return connection.read(protocol.NEWEST_ERROR) & 0xFFFF


def read_optional(connection: CanConnection, entry: Object) -> int | None:
    """Read an object of the drive; None if it has no such object."""
    try:
        return connection.read(entry)
    except SdoRefusal as refusal:
        if refusal.code not in protocol.MISSING:
            raise
        return None


class Setting(NamedTuple):
    """Object whose value would make units or limits wrong, and what is to be done about it."""

    entry: Object
    fits: Callable[[int], bool]
    fix: str


def settings(config: Epos2Config) -> tuple[Setting, ...]:
    """List the objects that must fit before anything is written."""
    in_epos_studio = "set it to 0 in EPOS Studio, or every {} is off by powers of ten"
    return (
        Setting(
            protocol.DEVICE_TYPE,
            # CiA 402: the number of the profile for drives is in the lower half.
            lambda value: value & 0xFFFF == 402,
            "not a CiA 402 drive; correct drive.node",
        ),
        Setting(
            protocol.MOTOR_TYPE,
            # From memory: 1 is a DC motor, 10 and 11 are brushless ones. All of them take the same
            # commands.
            lambda value: value in (1, 10, 11),
            "not a motor type that softfin supports; set the motor type in EPOS Studio",
        ),
        Setting(
            protocol.ENCODER_LINES,
            lambda value: value == config.encoder_lines,
            f"lines in the drive, but encoder_lines is {config.encoder_lines} in the rig's file; "
            "correct the wrong one, or every angle will be wrong",
        ),
        Setting(
            protocol.POSITION_NOTATION, lambda value: value == 0, in_epos_studio.format("angle")
        ),
        Setting(
            protocol.VELOCITY_NOTATION, lambda value: value == 0, in_epos_studio.format("velocity")
        ),
        Setting(
            protocol.ACCELERATION_NOTATION,
            lambda value: value == 0,
            in_epos_studio.format("acceleration"),
        ),
    )


def check_settings(connection: CanConnection, config: Epos2Config) -> tuple[str, ...]:
    """Raise RigError for a drive in fault, enabled by somebody else, or set up otherwise than the
    rig's file says.

    Return a note for each object that the drive does not have.
    """
    if fault := read_fault(connection):
        raise RigError(f"{fault}; then run: softfin rig check --reset-fault")
    word = connection.read(protocol.STATUSWORD)
    state = protocol.decode(word)
    if state not in protocol.UNPOWERED:
        words = state.words if state else f"not of an EPOS2 (statusword 0x{word:04X})"
        raise RigError(
            f"drive is already {words}; close the program that drives it, or switch it off and on"
        )
    notes = []
    for setting in settings(config):
        value = read_optional(connection, setting.entry)
        if value is None:
            notes.append(f"drive has no {setting.entry}; check this setting in EPOS Studio")
        elif not setting.fits(value):
            raise RigError(f"drive's {setting.entry} is {value}: {setting.fix}")
    return tuple(notes)


def set_reactions(connection: CanConnection) -> tuple[str, ...]:
    """Set what stops the fin when softfin dies; return a note for each object that the drive does
    not have."""
    notes = []
    for entry, value in protocol.REACTIONS.items():
        try:
            write(connection, entry, value)
        except SdoRefusal as refusal:
            if refusal.code not in protocol.MISSING:
                raise
            notes.append(
                f"drive has no {entry}; only rig check --prove shows whether it stops by itself"
            )
    return tuple(notes)


def set_sync(connection: CanConnection, config: Epos2Config) -> int:
    """Have the drive answer to this program's own SYNC alone; return the COB-ID that it answers
    to."""
    wanted = protocol.SYNC + config.host
    try:
        connection.write(protocol.SYNC_ID, wanted)
        held = connection.read(protocol.SYNC_ID) & 0x7FF
    except SdoRefusal:
        # Whether an EPOS2 lets it be changed is not known; it then keeps the one that CiA 301 gives
        # to all.
        held = (read_optional(connection, protocol.SYNC_ID) or protocol.SYNC) & 0x7FF
    if held not in (wanted, protocol.SYNC):
        raise RigError(
            f"drive's {protocol.SYNC_ID} stayed 0x{held:03X}; close other programs, switch it off "
            "and on"
        )
    return held


def configure(connection: CanConnection, config: Epos2Config) -> None:
    """Write limits, profile, mode, heartbeat and process data; the node must be pre-operational."""
    units = Units.of(config)
    # softfin keeps its commands within the range itself. A stroke to its end may overshoot by some
    # counts, at which a drive that judges its actual position would fault.
    lowest = units.counts(config.angle_min_rad - OVERSHOOT_RAD)
    highest = units.counts(config.angle_max_rad + OVERSHOOT_RAD)
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
        values[protocol.CURRENT_LIMIT] = round(1000 * config.current_limit_a)
    for entry, value in values.items():
        write(connection, entry, value)
    set_mode(connection, protocol.PROFILE_POSITION)
    # Ten heartbeats in the time after which silence means that the drive is gone.
    write(connection, protocol.HEARTBEAT_PRODUCER, round(1000 * config.heartbeat_s / 10))
    for first, pdos, cob_id, transmission in (
        (0x1800, protocol.SENT, protocol.TPDO[0], protocol.ON_SYNC),
        (0x1400, protocol.TAKEN, protocol.RPDO[0], protocol.AT_ONCE),
    ):
        # All four of each kind: what else the drive was once told to send and take is turned off.
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
    """Write an object, read it or the one that shows it back; raises RigError where the drive holds
    another value."""
    connection.write(entry, value)
    held = connection.read(shown or entry)
    if (held ^ value) & mask:
        raise RigError(
            f"drive's {shown or entry} stayed {held} when {value} was written; close EPOS Studio "
            "and other programs, or set a value in the rig's file that the drive accepts"
        )


def set_mode(connection: CanConnection, mode: int) -> None:
    """Set the mode of operation; raises RigError where the drive is not in it then."""
    write(connection, protocol.MODE, mode, shown=protocol.MODE_DISPLAY)


def _map(
    connection: CanConnection,
    number: int,
    cob_id: int,
    entries: tuple[Object, ...],
    transmission: int,
) -> None:
    """Mapping objects are 0x200 above those of the communication; a PDO must be off while its
    mapping changes."""

    def set_cob_id(value: int) -> None:
        entry = Object(number, 1, "I", "COB-ID")
        write(connection, entry, value | NO_REMOTE_REQUEST, mask=protocol.INVALID | 0x7FF)

    set_cob_id(cob_id | protocol.INVALID)
    if not entries:
        return
    count = Object(number + 0x200, 0, "B", "mapped objects")
    connection.write(count, 0)
    for place, entry in enumerate(entries, 1):
        write(connection, Object(number + 0x200, place, "I", "mapping"), entry.mapping)
    write(connection, count, len(entries))
    write(connection, Object(number, 2, "B", "transmission type"), transmission)
    set_cob_id(cob_id)


def reach_enabled(exchange: Exchange, then_arm: bool, meanwhile: Callable[[], object]) -> None:
    """Bring the drive to operation enabled, unless it is stopped meanwhile; raises DeviceError.

    Calls `meanwhile` at each step.
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
            # Every frame on the bus wakes it: those of other fins must not use up the time that
            # this drive may take.
            exchange.lock.wait_for(lambda: exchange.stopped, STATE_STEP_S)
    raise DeviceError(
        f"drive stays {status.words} and does not enable; check its supply and its enable input"
    )


def home(exchange: Exchange) -> None:
    """Have a drive that is enabled in homing mode take the present position as home; raises
    DeviceError."""
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
        # Twice: bit 12 may still stand from an earlier homing.
        if attained >= 2 and (status.has(Bit.REFERENCED) or not exchange.config.zero_needed):
            return
        exchange.clock.sleep(STATE_STEP_S)
    raise DeviceError("drive did not accept its position as home; hold the fin still and try again")


def rest(exchange: Exchange) -> bool:
    """Wait for standstill after a quick stop, take the voltage off; returns whether the drive
    confirms that."""
    status = exchange.status
    config = exchange.config

    def stands() -> bool:
        braked = (
            status.state is State.QUICK_STOP_ACTIVE
            and exchange.units.rpm(status.velocity) <= STANDSTILL_RPM
        )
        return exchange.is_off or (braked and status.new)

    # Twice what braking from the highest velocity takes, and ten ticks.
    braking = 2 * config.fastest_rad_s / config.quick_stop_rad_s2 + 10 * config.sync_s
    if not _insist_until(exchange, protocol.QUICK_STOP, stands, braking):
        # The first word that gets through must not be the one that lets the fin coast.
        return False
    _insist_until(exchange, protocol.DISABLE_VOLTAGE, lambda: exchange.is_off, DISABLE_TIMEOUT_S)
    if exchange.is_off:
        return True
    # Without process data, as of a node that is not operational, the drive can still be asked.
    is_there = exchange.clock() - status.heartbeat_time <= config.heartbeat_s
    if exchange.rest_failed and not is_there:
        return False
    return protocol.decode(exchange.connection.read(protocol.STATUSWORD)) in protocol.UNPOWERED


def _insist_until(exchange: Exchange, word: int, done: Callable[[], bool], seconds: float) -> bool:
    """Repeat a controlword until it is done or the time is over; return False if the bus takes no
    frames.

    The time is counted in ticks, so that a stopped clock ends it too. If an earlier stop tried all
    of it in vain, it is brief unless the drive obeys now: a person has to know soon.
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
        # A node may say that it is operational and still take no process data.
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
    """Withhold the heartbeats of a powered drive until it faults by itself; return how long that
    takes [s].

    Raises DeviceError if it does not fault for the loss of the heartbeats, or does not take its
    power off.
    """
    exchange.send_heartbeat()
    last_heartbeat = exchange.clock()
    longest = exchange.config.heartbeat_s + LOSS_MARGIN_S
    while (silence := exchange.clock() - last_heartbeat) <= longest:
        # All goes on as in a run but the heartbeats: nothing else may be what stops it. After the
        # fault the node may have left the operational state, in which it answers no SYNC, so its
        # state is read.
        exchange.sync_and_read(STATE_STEP_S)
        state = protocol.decode(exchange.connection.read(protocol.STATUSWORD))
        if state is State.FAULT:
            code = exchange.status.emergency or newest_error(exchange.connection)
            if code != protocol.HOST_LOST:
                raise DeviceError(f"drive faulted for another reason: {fault_line(code)}")
            return silence
        exchange.clock.sleep(STATE_STEP_S)
    raise DeviceError(
        f"drive ignores the loss of softfin's heartbeats: no fault within {longest:.1f} s, so a "
        f"fin would keep moving if softfin died; set {protocol.LOSS_REACTION} to 1 and "
        f"{protocol.FAULT_REACTION} to 2 in EPOS Studio, and move nothing until this test passes"
    )


def switch_off(exchange: Exchange) -> bool:
    """Quick stop, then no voltage, whatever state drive and node are in; return whether the motor
    is then off.

    By process data first, which take effect at once where they are mapped as softfin maps them, and
    by SDO.
    """
    connection = exchange.connection
    config = exchange.config

    def order(word: int) -> State | None:
        exchange.attempt(*exchange.order(word))
        try:
            connection.write(protocol.CONTROLWORD, word)
            return protocol.decode(connection.read(protocol.STATUSWORD))
        except DeviceError:
            # A node that is stopped answers no SDO; pre-operational it does.
            exchange.attempt(protocol.NMT, bytes([protocol.NMT_PRE_OPERATIONAL, config.node]))
            return None

    def brakes() -> bool:
        return order(protocol.QUICK_STOP) not in protocol.UNPOWERED and not stands()

    def stands() -> bool:
        velocity = read_optional(connection, protocol.VELOCITY)
        return velocity is not None and abs(velocity) <= STANDSTILL_RPM

    def until(done: Callable[[], bool], seconds: float) -> bool:
        """Until it is done or the time is over, but three times at least: one unanswered request
        may take it all."""
        end = exchange.clock() + seconds
        attempts = 0
        while attempts < REFUSED or exchange.clock() <= end:
            attempts += 1
            with contextlib.suppress(DeviceError):
                if done():
                    return True
            exchange.clock.sleep(config.sync_s)
        return False

    # As long as braking from the highest velocity may take; then the voltage is taken whether it
    # stands or not.
    until(
        lambda: not brakes(), config.fastest_rad_s / config.quick_stop_rad_s2 + 10 * config.sync_s
    )
    if not until(lambda: order(protocol.DISABLE_VOLTAGE) in protocol.UNPOWERED, DISABLE_TIMEOUT_S):
        return False
    return _stays_off(exchange)


def _stays_off(exchange: Exchange) -> bool:
    """Watch the motor for a while: a program that still drives it would power it again."""
    for _ in range(round(STOP_CONFIRMED_S / exchange.config.sync_s)):
        state = protocol.decode(exchange.connection.read(protocol.STATUSWORD))
        if state not in protocol.UNPOWERED:
            return False
        exchange.clock.sleep(exchange.config.sync_s)
    return True
