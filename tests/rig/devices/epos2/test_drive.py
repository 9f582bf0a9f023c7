"""The drive against its emulator: start, motion, everything that can go wrong, stop."""

import itertools
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext

import can
import pytest

from softfin.core.errors import CommandError, DeviceError, RigError, SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2 import motor as emulated_motor
from softfin.emulation.epos2.drive import DriveTraits
from softfin.rig.bus import BusConfig
from softfin.rig.devices.epos2 import procedures, protocol
from softfin.rig.devices.epos2.connection import CanConnection, download
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.devices.epos2.procedures import BUS_REFUSES_S
from softfin.rig.devices.epos2.protocol import FAULT_STATES, POWERED, Object, State
from softfin.rig.machine import Target
from softfin.rig.safety import check_target
from tests.rig.devices.epos2.bench import (
    NODE,
    Bench,
    Sniffer,
    bench,
    block,
    bus_config,
    drive_config,
    enabled,
    ignore_targets,
)

AT_REST = [state for state in State if state not in POWERED]


def test_opening_gives_no_power_and_the_drive_holds_our_limits() -> None:
    with bench(current_limit_a=1.5, angle_min_rad=-1.0, angle_max_rad=0.5) as made:
        made.drive.open()
        assert made.drive.status.state is State.SWITCH_ON_DISABLED
        assert made.drive.complaints() == ()
        assert not made.drive.referenced
        ask = made.drive.connection.read
        units = made.drive.units
        # A stroke to the end of the range may overshoot a little, and is no fault.
        assert ask(protocol.POSITION_MIN) == units.counts(-1.15)
        assert ask(protocol.POSITION_MAX) == units.counts(0.65)
        assert made.drive.notes == ()
        assert [ask(entry) for entry in protocol.REACTIONS] == [1, 2, 6]
        assert ask(protocol.SYNC_ID) == made.drive.sync_id == 0x080 + 127 - NODE
        assert ask(protocol.QUICK_STOP_DECELERATION) == units.rpm(60.0)
        assert ask(protocol.CURRENT_LIMIT) == 1500
        assert ask(protocol.MODE_DISPLAY) == 1


def test_a_target_moves_the_fin_and_another_one_at_once_turns_it_back() -> None:
    with enabled() as made:
        made.drive.command(Target(1.0, 3.0))
        assert made.until(lambda: made.fin.now().angle > 0.3)
        made.drive.command(Target(-0.5, 3.0))
        assert made.until(lambda: abs(made.fin.now().angle + 0.5) < 1e-3)
        reading = made.drive.sync_and_read(0.1)
        assert reading.new
        assert reading.angle == pytest.approx(-0.5, abs=1e-3)
        assert made.drive.complaints() == ()


def test_the_frames_of_a_target_are_golden() -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.command(Target(1.0, 2.0))
        assert made.until(lambda: made.fin.now().angle > 0.05)
        counts = round(4 * 500 * 66 / (2 * 3.141592653589793))
        rpm = round(2 * 60 * 66 / (2 * 3.141592653589793))
        assert sniffer.controlwords()[:2] == [0x003F, 0x000F]
        sent = [
            (cob_id, data)
            for _, cob_id, data in sniffer.frames
            if cob_id in {0x200 + NODE, 0x300 + NODE}
        ]
        assert sent[0] == (0x300 + NODE, struct.pack("<I", rpm))
        assert sent[1] == (0x200 + NODE, b"\x3f\x00" + struct.pack("<i", counts))


def test_every_one_of_many_quick_targets_ends_at_the_last() -> None:
    with enabled() as made:
        for k in range(50):
            made.drive.command(Target(0.01 * k, 3.0))
        assert made.until(lambda: abs(made.fin.now().angle - 0.49) < 1e-3)


def test_a_lost_acknowledge_is_asked_for_again() -> None:
    with enabled() as made:
        ignore_targets(made.emulated, 1)
        made.drive.command(Target(0.3, 3.0))
        assert made.until(lambda: abs(made.fin.now().angle - 0.3) < 1e-3)
        assert made.drive.counters()["targets repeated"] >= 1


@pytest.mark.parametrize("direction", [1, -1])
def test_directions_and_offsets_agree_with_the_emulated_fin(direction: int) -> None:
    with enabled(direction=direction) as made:
        made.drive.command(Target(0.4, 3.0))
        assert made.until(lambda: abs(made.fin.now().angle - 0.1) < 0.01)
        assert made.drive.sync_and_read(0.1).current == pytest.approx(
            made.fin.now().current, abs=1e-3
        )
        assert made.emulated.motor.current * direction > 0
        assert made.until(lambda: abs(made.fin.now().angle - 0.4) < 1e-3)
        assert made.drive.sync_and_read(0.1).angle == pytest.approx(0.4, abs=1e-3)


def test_homing_moves_nothing_and_makes_here_zero() -> None:
    with bench() as made:
        made.fin.move(0.7, 100.0)
        made.clock.sleep(0.05)
        made.drive.open()
        made.drive.zero()
        assert made.fin.now().angle == pytest.approx(0.7)
        assert made.drive.referenced
        assert made.drive.sync_and_read(0.1).angle == pytest.approx(0.0, abs=1e-3)
        assert made.drive.status.state in AT_REST


def test_a_fin_without_a_zero_is_not_enabled() -> None:
    with bench() as made:
        made.drive.open()
        with pytest.raises(RigError, match="softfin rig zero --arm"):
            made.drive.enable()
        assert made.emulated.state in AT_REST


@pytest.mark.parametrize(("angle", "refused"), [(0.6, False), (0.7, True)])
def test_a_fin_is_enabled_a_little_beyond_its_limits_and_no_further(
    angle: float, refused: bool
) -> None:
    with bench(angle_min_rad=-1.0, angle_max_rad=0.5, zero_offset_rad=angle) as made:
        made.drive.open()
        made.drive.zero()
        with pytest.raises(RigError, match=r"outside -1 \.\. 0\.5") if refused else nullcontext():
            made.drive.enable()
        assert (made.emulated.state in AT_REST) is refused


@pytest.mark.parametrize(
    "target", [(2.0, 2.0), (0.0, 4.0), (0.0, 0.1), (float("nan"), 2.0), (0.0, float("inf"))]
)
def test_a_command_outside_the_limits_is_refused_and_nothing_moves(
    target: tuple[float, float],
) -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        with pytest.raises(CommandError, match="this fin accepts"):
            made.drive.command(Target(*target))
        made.until(lambda: True)
        assert 0x003F not in sniffer.controlwords()


def test_a_command_before_enable_and_after_stop_is_refused() -> None:
    with bench() as made:
        made.drive.open()
        with pytest.raises(DeviceError, match="not enabled"):
            made.drive.command(Target(0.1, 2.0))
        made.drive.zero()
        made.drive.enable()
        made.drive.stop()
        with pytest.raises(DeviceError, match="not enabled"):
            made.drive.command(Target(0.1, 2.0))
        assert made.emulated.state in AT_REST


def test_an_empty_bus_says_where_to_look() -> None:
    drive = Epos2(bus_config(), drive_config(), SimulatedClock())
    with pytest.raises(
        RigError, match=r"no drive responds as node 5 on CAN bus virtual .*; compare drive\.node"
    ):
        drive.open()
    drive.close()


def test_a_bus_that_does_not_exist_is_named_in_one_line() -> None:
    for bus in (
        BusConfig(interface="nonesuch", channel="can7"),
        BusConfig(interface="socketcand", channel="can7", options={"host": "127.0.0.1", "port": 1}),
    ):
        with pytest.raises(RigError, match=r"can7 cannot be opened") as caught:
            Epos2(bus, drive_config()).open()
        assert "\n" not in str(caught.value)


def test_a_drive_that_is_set_up_for_another_encoder_is_refused() -> None:
    with bench() as made:
        made.emulated._node.sdo.download(0x2210, 1, struct.pack("<I", 1024))
        with pytest.raises(
            RigError, match=r"is 1024: lines in the drive, but encoder_lines is 500"
        ):
            made.drive.open()


def test_a_limit_that_the_drive_does_not_hold_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as made:
        store = made.emulated._node.set_data

        def forgetful(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
            store(index, subindex, bytes(len(data)) if index == 0x6085 else data, check_writable)

        monkeypatch.setattr(made.emulated._node, "set_data", forgetful)
        with pytest.raises(RigError, match="quick-stop deceleration"):
            made.drive.open()


def test_a_drive_in_fault_is_refused_with_its_name_and_reset_only_when_asked() -> None:
    with bench() as made:
        made.emulated.fault(0x2310)
        with pytest.raises(RigError, match=r"over-current.*--reset-fault"):
            made.drive.open()
        made.clock.sleep(0.02)
        assert made.emulated.state is State.FAULT
        made.drive.connect()
        fault = made.drive.reset_fault()
        assert fault is not None
        assert "over-current" in fault
        assert made.drive.reset_fault() is None
        made.drive.close()
        made.drive.open()
        assert made.drive.complaints() == ()


def test_a_drive_that_another_program_has_enabled_is_left_alone() -> None:
    with enabled() as made:
        made.drive.command(Target(1.0, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.1)
        other = Epos2(made.bus, drive_config(host_node=126), made.clock)
        with swimming(made), pytest.raises(RigError, match="already operation enabled"):
            other.open()
        assert made.until(lambda: made.fin.now().angle > 0.9)


@contextmanager
def swimming(made: Bench) -> Iterator[None]:
    """Keep the loop of the drive going in a thread."""
    ended = made.clock.event()

    def loop() -> None:
        while not ended.wait(0.01):
            made.drive.send_heartbeat()
            made.drive.sync_and_read(0.003)

    thread = made.clock.spawn(loop, "loop")
    try:
        yield
    finally:
        ended.set()
        thread.join()


def complaint(made: Bench, words: str) -> bool:
    return made.until(lambda: any(words in line for line in made.drive.complaints()))


def test_an_emergency_is_told_at_once_and_complained_of_by_name() -> None:
    with enabled() as made:
        made.emulated.fault(0x8611)
        assert complaint(made, "0x8611, following error")
        assert "following error" in made.faults[0]
        made.drive.stop()
        assert made.emulated.state in FAULT_STATES


def send(made: Bench, cob_id: int, data: bytes) -> None:
    with Sniffer(made) as sniffer:
        sniffer.send(cob_id, data)


@pytest.mark.parametrize(
    ("inject", "words"),
    [
        (lambda made: block(made.fin), "following error"),
        (lambda made: made.emulated.drop_heartbeat(), "heartbeat has been missing"),
        (lambda made: made.emulated.go_silent(), "heartbeat has been missing"),
        (lambda made: ignore_targets(made.emulated, 1000), "did not acknowledge a target"),
        (
            lambda made: send(made, 0x200 + NODE, bytes(6)),
            "switch on disabled although it was enabled",
        ),
        (lambda made: send(made, 0x000, bytes([0x80, NODE])), "left the operational state"),
    ],
    ids=[
        "blocked fin",
        "no heartbeat",
        "cut cable",
        "no target taken",
        "switched off",
        "not operational",
    ],
)
def test_what_goes_wrong_is_complained_of_and_the_fin_is_stopped(
    inject: Callable[[Bench], None], words: str
) -> None:
    with enabled(heartbeat_s=0.3) as made:
        inject(made)
        made.drive.command(Target(1.0, 3.0))
        assert complaint(made, words)
        made.drive.stop()
        assert made.until(lambda: made.emulated.state in AT_REST)
        assert made.fin.now().velocity == 0.0


def test_a_host_that_hangs_makes_the_drive_stop_by_itself() -> None:
    with enabled(heartbeat_s=0.2) as made:
        made.drive.command(Target(1.5, 1.0))
        made.clock.sleep(1.0)
        stopped = made.fin.now()
        assert made.emulated.state in FAULT_STATES
        assert stopped.velocity == 0.0
        assert stopped.angle < 1.4
        assert complaint(made, "0x8130")


def test_a_drive_that_started_anew_is_complained_of_and_takes_no_target() -> None:
    with enabled() as made:
        made.emulated.reboot()
        assert complaint(made, "restarted")
        assert made.emulated.state in AT_REST
        angle = made.fin.now().angle
        made.drive.command(Target(1.0, 3.0))
        made.drive.stop()
        assert made.fin.now().angle == angle


def test_a_bus_that_takes_no_frames_is_a_complaint_and_no_error_in_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with enabled() as made:
        bus = made.drive.connection._bus

        def refuse(*_: object) -> None:
            raise can.CanOperationError("transmit buffer full")

        monkeypatch.setattr(bus, "send", refuse)
        made.drive.send_heartbeat()
        assert not made.drive.sync_and_read(0.001).new
        assert any("does not accept frames" in line for line in made.drive.complaints())
        made.drive.stop()
        monkeypatch.undo()


def test_receiving_errors_are_told_and_do_not_end_the_receiver(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with enabled() as made:
        bus = made.drive.connection._bus
        assert bus is not None
        receive = bus.recv
        left = [3]

        def stumble(timeout: float | None = None) -> can.Message | None:
            if left[0]:
                left[0] -= 1
                raise can.CanOperationError("bus off")
            return receive(timeout)

        monkeypatch.setattr(bus, "recv", stumble)
        assert complaint(made, "cannot be read (bus off)")
        assert made.until(lambda: left[0] == 0 and made.drive.sync_and_read(0.1).new)
        assert made.faults


@pytest.mark.parametrize(
    ("classes", "controller", "name"),
    [
        (0x02, 0, "lost arbitrations"),
        (0x04, 0x08, "error warnings"),
        (0x08, 0, "protocol violations"),
        (0x20, 0, "frames without acknowledge"),
        (0x00, 0, "error frames"),
    ],
)
def test_an_error_that_the_bus_mends_itself_is_counted_and_no_stop(
    classes: int, controller: int, name: str
) -> None:
    with enabled() as made:
        made.emulated.send_error_frame(classes, controller)
        made.emulated.send_error_frame(classes, controller)
        assert made.until(lambda: made.drive.counters().get(name) == 2)
        assert made.drive.complaints() == ()
        assert made.faults == []


@pytest.mark.parametrize(
    ("classes", "controller", "name"), [(0x40, 0, "bus-off"), (0x04, 0x20, "error passive")]
)
def test_an_adapter_that_gives_up_is_told_at_once(classes: int, controller: int, name: str) -> None:
    with enabled() as made:
        made.emulated.send_error_frame(classes, controller)
        assert complaint(made, f"the adapter is {name}; check its cable")
        assert name in made.faults[0]


def test_a_limit_that_is_touched_for_a_moment_is_no_complaint_and_one_that_lasts_is() -> None:
    with enabled() as made:
        made.emulated.at_limit = True
        began = made.clock()
        assert made.until(lambda: made.clock() - began > 0.08)
        assert made.drive.complaints() == ()
        made.emulated.at_limit = False
        assert made.until(lambda: made.clock() - began > 0.3)
        assert made.drive.complaints() == ()
        made.emulated.at_limit = True
        assert complaint(made, "has reached one of its internal limits")


def test_a_fin_whose_voltage_is_taken_coasts_and_one_that_is_stopped_stands() -> None:
    ways = []
    for word in (0x0000, 0x0002):
        with enabled() as made, Sniffer(made) as sniffer:
            made.drive.command(Target(1.5, 3.0))
            assert made.until(lambda made=made: made.fin.now().angle > 0.3)
            began = made.fin.now().angle
            sniffer.send(*made.drive.order(word))
            made.clock.sleep(0.01)
            assert (made.fin.now().velocity == 0.0) is (word == 0x0002)
            made.clock.sleep(0.5)
            assert made.fin.now().velocity == 0.0
            ways.append(made.fin.now().angle - began)
    # v^2 / (2 * 10 rad/s2)
    assert ways[0] == pytest.approx(0.45, abs=0.03)
    assert ways[1] < 0.03


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        (protocol.MOTOR_TYPE, 3, "motor type .* is 3: an unsupported motor type"),
        (
            protocol.VELOCITY_NOTATION,
            -3,
            "velocity notation index .* is -3: .*; set it to 0 in EPOS Studio",
        ),
        (protocol.POSITION_NOTATION, 1, "every angle would be wrong by a power of ten"),
        (protocol.ACCELERATION_NOTATION, 1, "every acceleration would be wrong by a power of ten"),
    ],
)
def test_a_setting_that_changes_units_is_refused(entry: Object, value: int, words: str) -> None:
    with bench() as made:
        made.emulated._node.sdo.download(entry.number, entry.sub, entry.layout.pack(value))
        with pytest.raises(RigError, match=words):
            made.drive.open()


def test_settings_that_a_drive_does_not_have_are_notes() -> None:
    with bench(
        traits=DriveTraits(missing=frozenset({protocol.MOTOR_TYPE, protocol.SERIAL_NUMBER}))
    ) as made:
        made.drive.open()
        assert made.drive.notes == (
            "drive has no motor type (0x6402.0); check this setting in EPOS Studio",
        )
        assert made.drive.serial is None


def test_other_devices_are_read_while_the_drive_is_being_enabled() -> None:
    with bench() as made:
        made.drive.open()
        made.drive.zero()
        times: list[float] = []
        made.drive.enable(meanwhile=lambda: times.append(made.clock()))
        assert len(times) > 2
        assert max(later - earlier for earlier, later in itertools.pairwise(times)) < 0.02


def test_an_on_fault_that_fails_does_not_end_the_receiver() -> None:
    with enabled() as made:
        made.drive.on_fault = lambda line: 1 / 0
        made.emulated.fault(0x8611)
        assert complaint(made, "failed: division by zero")
        assert made.drive.sync_and_read(0.5).new


def test_a_stop_sends_quick_stop_first_and_ends_without_voltage() -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.command(Target(1.0, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.01)
        made.drive.stop()
        assert made.fin.now().velocity == 0.0
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        words = sniffer.controlwords()
        stop = words.index(0x0002)
        assert set(words[stop:]) == {0x0002, 0x0000}
        assert words[-1] == 0x0000


def test_a_stop_is_safe_in_any_state_any_number_of_times() -> None:
    with bench() as made:
        made.drive.stop()
        made.drive.open()
        made.drive.stop()
        made.drive.stop()
        made.drive.zero()
        made.drive.enable()
        made.drive.stop()
        made.drive.stop()
        assert made.emulated.state in AT_REST
        made.drive.enable()
        assert made.emulated.state is State.OPERATION_ENABLED
        made.drive.close()
        made.drive.close()
        made.drive.stop()
        assert made.emulated.state in AT_REST


def test_a_stop_within_on_fault_brakes_at_once_and_takes_the_voltage_off() -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.on_fault = lambda _: made.drive.stop()
        made.drive.command(Target(1.0, 1.0))
        # An emergency that only tells: the emulated drive itself goes on.
        made.emulated._emergency(0x4210)
        assert made.until(lambda: 0x0002 in sniffer.controlwords())
        assert made.until(lambda: made.emulated.state is State.SWITCH_ON_DISABLED)


def test_many_threads_may_stop_at_once() -> None:
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        threads = [made.clock.spawn(made.drive.stop, f"stop {k}") for k in range(8)]
        for thread in threads:
            thread.join(10.0)
        assert not any(thread.is_alive() for thread in threads)
        assert made.emulated.state in AT_REST
        assert made.fin.now().velocity == 0.0


def test_a_stop_while_it_is_being_enabled_wins() -> None:
    with bench() as made:
        made.drive.open()
        made.drive.zero()
        drive = made.drive
        read = drive.sync_and_read
        calls = [0]

        def stopped_midway(timeout: float) -> object:
            calls[0] += 1
            if calls[0] == 3:
                drive.brake()
            return read(timeout)

        drive.sync_and_read = stopped_midway  # type: ignore[method-assign, assignment]
        with pytest.raises(DeviceError, match="stopped while it was being enabled"):
            made.drive.enable()
        assert made.emulated.state in AT_REST


def test_a_stop_of_a_node_that_takes_no_process_data_goes_by_sdo() -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.command(Target(1.5, 1.0))
        sniffer.send(0x000, bytes([0x80, NODE]))
        assert made.until(lambda: made.drive.status.nmt == 0x7F)
        made.drive.stop()
        assert made.emulated.state in AT_REST
        assert (0x600 + NODE, bytes.fromhex("2b40600002000000")) in [
            frame[1:] for frame in sniffer.frames
        ]


def test_a_closed_drive_is_free_for_the_next_program_without_a_fault() -> None:
    with enabled(heartbeat_s=0.1) as made:
        made.drive.close()
        made.clock.sleep(0.4)
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        made.drive.open()
        assert made.drive.referenced
        made.drive.enable()


def test_a_send_that_hangs_does_not_hang_the_stop() -> None:
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        hung = made.clock.event()
        free = made.clock.event()

        def hang() -> None:
            with made.drive.lock:
                hung.set()
                free.wait(20.0)

        thread = made.clock.spawn(hang, "hanging send")
        hung.wait(5.0)
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 0.1
        # The quick stop went out all the same.
        made.clock.sleep(0.0)
        assert made.fin.now().velocity == 0.0
        free.set()
        thread.join()
        assert made.until(lambda: made.emulated.state is State.SWITCH_ON_DISABLED)


def test_a_target_whose_first_frame_hangs_does_not_follow_the_stop_that_went_past_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with enabled(heartbeat_s=1.0) as made, Sniffer(made) as sniffer:
        bus = made.drive.connection._bus
        stopped = []
        send = bus.send

        def hang(message: can.Message, timeout: float | None = None) -> None:
            send(message, timeout)
            if message.arbitration_id == 0x300 + NODE and not stopped:
                stopped.append(made.clock.spawn(made.drive.stop, "stop"))
                made.clock.sleep(0.3)

        monkeypatch.setattr(bus, "send", hang)
        made.drive.command(Target(1.5, 1.0))
        stopped[0].join()
        assert made.until(lambda: made.emulated.state is State.SWITCH_ON_DISABLED)
        assert protocol.NEW_TARGET not in sniffer.controlwords()


def test_a_homing_that_failed_does_not_leave_its_mode_for_targets() -> None:
    with bench() as made:
        made.drive.open()
        made.drive.zero()
        made.emulated._node.sdo.download(0x6060, 0, b"\x06")
        made.drive.enable()
        made.drive.command(Target(0.2, 3.0))
        assert made.until(lambda: abs(made.fin.now().angle - 0.2) < 1e-3)
        assert made.drive.sync_and_read(0.1).angle == pytest.approx(0.2, abs=1e-3)


def test_a_stop_that_the_drive_does_not_confirm_is_unconfirmed_and_a_complaint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    obey = emulated_motor.next_state
    with enabled() as made:
        assert made.until(lambda: True)
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None
        made.drive.enable()
        monkeypatch.setattr(
            emulated_motor,
            "next_state",
            lambda state, word, before: state if word in (0, 2) else obey(state, word, before),
        )
        # Else it would stop by itself, without our heartbeats, and the stop be confirmed.
        monkeypatch.setattr(made.emulated, "fault", lambda code: None)
        made.drive.stop()
        assert "press the emergency stop" in made.drive.stop_unconfirmed
        assert made.drive.stop_unconfirmed in made.drive.complaints()
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 0.2
        monkeypatch.undo()
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None


def test_a_command_that_safety_lets_pass_is_taken_and_put_on_the_limit() -> None:
    # A controller for pi/2, and a rig's file that says 1.57.
    with enabled(angle_max_rad=1.57) as made:
        target = Target(1.5708, 3.14)
        assert check_target(target, made.drive.config.limits) is None
        made.drive.command(target)
        assert made.until(lambda: made.drive.sync_and_read().angle == pytest.approx(1.57, abs=1e-3))
        assert made.emulated.state is protocol.State.OPERATION_ENABLED


def test_a_stop_over_a_bus_that_takes_no_frames_ends_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    with enabled() as made:
        bus = made.drive.connection._bus
        tried = list[int]()

        def send(message: can.Message, timeout: float | None = None) -> None:
            tried.append(message.arbitration_id)
            made.clock.sleep(0.001)
            raise can.CanOperationError("transmit buffer full")

        monkeypatch.setattr(bus, "send", send)
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 2 * BUS_REFUSES_S
        assert 0x200 + NODE in tried
        assert "press the emergency stop" in made.drive.stop_unconfirmed
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 0.05
        monkeypatch.undo()


@pytest.mark.parametrize("refused_s", [0.03, 0.06, 0.12, 0.16])
def test_the_first_word_after_a_bus_took_no_frames_is_a_quick_stop(
    monkeypatch: pytest.MonkeyPatch, refused_s: float
) -> None:
    with enabled() as made:
        states = list[State]()
        enter = made.emulated._enter

        def note(state: State) -> None:
            if state is not made.emulated.state:
                states.append(state)
            enter(state)

        monkeypatch.setattr(made.emulated, "_enter", note)
        bus = made.drive.connection._bus
        send = bus.send
        until = made.clock() + refused_s

        def refuse(message: can.Message, timeout: float | None = None) -> None:
            if made.clock() < until:
                raise can.CanOperationError("transmit buffer full")
            send(message, timeout)

        monkeypatch.setattr(bus, "send", refuse)
        # As at the end of a session, which stops it several times.
        for _ in range(4):
            made.drive.stop()
            made.clock.sleep(0.02)
        assert states[0] is State.QUICK_STOP_ACTIVE
        assert made.drive.stop_unconfirmed is None


def test_a_stop_that_comes_while_the_drive_is_being_enabled_is_not_forgotten(monkeypatch) -> None:
    with bench() as made:
        made.drive.open()
        made.drive.zero()
        set_mode = procedures.set_mode

        def stop_and_set_mode(connection: CanConnection, mode: int) -> None:
            made.drive.stop()
            set_mode(connection, mode)

        monkeypatch.setattr(procedures, "set_mode", stop_and_set_mode)
        with pytest.raises(DeviceError, match="was stopped while it was being enabled"):
            made.drive.enable()
        made.clock.sleep(0.1)
        assert made.emulated.state in protocol.UNPOWERED


def test_a_drive_that_somebody_else_has_stopped_is_not_started_by_the_next_target() -> None:
    with enabled() as made:
        made.drive.command(Target(1.0, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.3)
        send(made, protocol.SDO_REQUEST + NODE, download(protocol.CONTROLWORD, protocol.QUICK_STOP))
        made.clock.sleep(0.01)
        made.drive.sync_and_read(0.02)
        made.drive.command(Target(-1.0, 1.0))
        where = made.fin.now().angle
        made.until(lambda: made.clock() < 0)
        assert made.emulated.state is State.QUICK_STOP_ACTIVE
        assert made.fin.now().angle == where


def test_a_drive_that_obeys_no_stop_is_left_to_its_own_watch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    obey = emulated_motor.next_state
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.3)
        monkeypatch.setattr(
            emulated_motor,
            "next_state",
            lambda state, word, before: state if word in (0, 2) else obey(state, word, before),
        )
        began = made.clock()
        # As at the end of a session, which stops it several times and reads it in between.
        for _ in range(5):
            made.drive.stop()
            made.drive.send_heartbeat()
        assert made.drive.stop_unconfirmed is None
        assert made.emulated.state in FAULT_STATES
        assert made.fin.now().angle < 0.3 + made.drive.config.heartbeat_s + 0.1
        assert made.clock() - began < 1.0


def test_a_node_that_somebody_has_stopped_is_stopped_by_sdo() -> None:
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.3)
        # It takes no controlwords, neither as process data nor by SDO, and still counts heartbeats.
        send(made, protocol.NMT, bytes([2, NODE]))
        assert made.until(lambda: made.drive.status.nmt == protocol.NODE_STOPPED)
        where = made.fin.now().angle
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None
        assert made.fin.now().angle < where + 0.1


def test_a_node_that_takes_no_process_data_is_stopped_by_sdo() -> None:
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.3)
        cob_id = Object(0x1400, 1, "I", "COB-ID")
        made.drive.connection.write(cob_id, protocol.INVALID | (protocol.RPDO[0] + NODE))
        where = made.fin.now().angle
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None
        assert made.fin.now().angle < where + 0.1


def test_a_fault_that_the_drive_clears_at_once_stays_a_complaint() -> None:
    with enabled() as made:
        for code in (0x8120, 0):
            send(made, protocol.EMERGENCY + NODE, code.to_bytes(2, "little") + bytes(6))
        assert complaint(made, "0x8120")


def test_a_host_with_our_number_is_a_complaint_whenever_it_begins_to_send() -> None:
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        assert made.until(lambda: made.fin.now().angle > 0.1)
        send(made, protocol.HEARTBEAT + made.drive.config.host, bytes([protocol.OPERATIONAL]))
        assert complaint(made, f"uses the node number of this program, {made.drive.config.host}")


def test_a_drive_is_not_enabled_if_its_bus_cannot_be_read_any_more() -> None:
    with bench() as made:
        made.drive.open()
        made.drive.zero()

        def lose_the_bus() -> None:
            made.drive.trouble = "bus cannot be read"

        with pytest.raises(DeviceError, match="bus cannot be read"):
            made.drive.enable(lose_the_bus)
        assert made.emulated.state is State.SWITCH_ON_DISABLED


def test_what_an_adapter_echoes_is_not_taken_for_another_host() -> None:
    with enabled() as made:
        heartbeat = protocol.HEARTBEAT + made.drive.config.host
        echo = can.Message(
            arbitration_id=heartbeat, data=bytes([5]), is_extended_id=False, is_rx=False
        )
        made.drive.connection._sort(echo)
        assert made.drive.complaints() == ()


@pytest.mark.parametrize("motion", ["home", "time_own_stop"])
def test_a_motor_that_may_still_be_on_is_told_whatever_else_went_wrong(
    monkeypatch: pytest.MonkeyPatch, motion: str
) -> None:
    with bench() as made:
        made.drive.open()

        def fail(_: Epos2) -> None:
            made.emulated.go_silent()
            raise KeyboardInterrupt

        monkeypatch.setattr(procedures, motion, fail)
        begin = made.drive.zero if motion == "home" else made.drive.prove_stop
        with pytest.raises(SafetyStop, match="interrupted; BUT drive did not confirm"):
            begin()


def test_ctrl_c_while_a_homing_brakes_does_not_hide_that_the_motor_may_be_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench() as made:
        made.drive.open()
        come_to_rest = made.drive._come_to_rest
        interrupts = [KeyboardInterrupt()]

        def interrupted(generation: int) -> None:
            if interrupts:
                made.emulated.go_silent()
                raise interrupts.pop()
            come_to_rest(generation)

        monkeypatch.setattr(made.drive, "_come_to_rest", interrupted)
        with pytest.raises(SafetyStop, match="BUT drive did not confirm"):
            made.drive.zero()
