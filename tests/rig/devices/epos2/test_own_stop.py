"""What stops a fin when softfin dies, how that is proved, and how a drive is stopped whoever has
powered it."""

import pytest

from softfin.core.errors import DeviceError, RigError
from softfin.emulation.epos2.drive import DriveTraits
from softfin.rig.devices.epos2 import procedures, protocol
from softfin.rig.devices.epos2.connection import CanConnection
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.devices.epos2.protocol import FAULT_STATES, POWERED, Object, State
from softfin.rig.machine import Target
from tests.rig.devices.epos2.bench import NODE, Bench, Sniffer, bench, drive_config, enabled

IGNORES = DriveTraits(ignores_heartbeat=True)
MISSING = DriveTraits(
    missing=frozenset({protocol.LOSS_REACTION, protocol.FAULT_REACTION, protocol.QUICK_STOP_OPTION})
)


@pytest.mark.parametrize("behaviour", [0, 1], ids=["drops to pre-operational", "stays operational"])
@pytest.mark.parametrize("heartbeat_s", [0.1, 0.2, 1.0])
def test_the_time_to_its_own_stop_is_measured_without_a_zero_and_without_motion(
    heartbeat_s: float, behaviour: int
) -> None:
    with bench(heartbeat_s=heartbeat_s) as made:
        made.drive.open()
        made.drive.connection.write(protocol.LOSS_BEHAVIOUR, behaviour)
        assert not made.drive.referenced
        assert heartbeat_s <= made.drive.prove_stop() <= heartbeat_s + 0.05
        assert made.fin.now().angle == 0.0
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        # Not even softfin's own reaction to a fault has taken the power off.
        assert made.faults == []


def test_it_is_proved_again_after_a_stop_and_only_on_an_open_drive() -> None:
    with bench() as made:
        with pytest.raises(DeviceError, match="drive is not open; open it first"):
            made.drive.prove_stop()
        made.drive.open()
        made.drive.stop()
        assert made.drive.prove_stop() > 0


def test_a_drive_that_ignores_the_loss_is_told_and_stopped() -> None:
    with bench(traits=IGNORES) as made:
        made.drive.open()
        began = made.clock()
        with pytest.raises(DeviceError, match="drive ignores missing heartbeats from softfin"):
            made.drive.prove_stop()
        assert made.clock() - began < 2.0
        assert made.emulated.state is State.SWITCH_ON_DISABLED


def test_a_proof_is_rejected_if_the_computer_pauses_during_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with bench() as made:
        made.drive.open()
        sync_and_read = made.drive.sync_and_read

        def sync_late(seconds: float) -> None:
            made.clock.sleep(2.0)
            sync_and_read(seconds)

        time_own_stop = procedures.time_own_stop

        def time_with_pause(drive: Epos2) -> float:
            monkeypatch.setattr(drive, "sync_and_read", sync_late)
            return time_own_stop(drive)

        monkeypatch.setattr(procedures, "time_own_stop", time_with_pause)
        with pytest.raises(DeviceError, match=r"paused for 2\.\d s during the stop test"):
            made.drive.prove_stop()
        assert made.emulated.state not in POWERED


def test_another_fault_is_no_proof() -> None:
    with bench() as made:
        made.drive.open()

        def fail_soon() -> None:
            made.clock.sleep(0.1)
            made.emulated.fault(0x4210)

        made.clock.spawn(fail_soon, "fault")
        with pytest.raises(DeviceError, match="different reason: drive fault 0x4210"):
            made.drive.prove_stop()
        assert made.emulated.state not in POWERED


def test_objects_that_a_drive_lacks_are_notes_and_it_is_opened() -> None:
    with bench(traits=MISSING) as made:
        made.drive.open()
        assert len(made.drive.notes) == 3
        assert "drive has no abort connection option (0x6007.0)" in made.drive.notes[0]
        assert made.drive.prove_stop() > 0


def test_a_reaction_that_does_not_stick_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with bench() as made:
        store = made.emulated._node.set_data

        def forgetful(index: int, subindex: int, data: bytes, check_writable: bool = False) -> None:
            store(index, subindex, bytes(len(data)) if index == 0x6007 else data, check_writable)

        monkeypatch.setattr(made.emulated._node, "set_data", forgetful)
        with pytest.raises(
            RigError, match=r"abort connection option \(0x6007\.0\) remained 0 after 1 was written"
        ):
            made.drive.open()


def test_a_fault_that_only_a_reset_of_the_communication_ends_is_reset_and_the_zero_kept() -> None:
    with enabled(traits=DriveTraits(needs_reset_of_communication=True), heartbeat_s=0.2) as made:
        made.drive.command(Target(1.5, 1.0))
        made.clock.sleep(0.5)
        assert made.emulated.state in FAULT_STATES
        other = Epos2(made.bus, drive_config(), made.clock)
        other.connect()
        assert "0x8130" in str(other.reset_fault())
        other.close()
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        other.open()
        assert other.referenced
        other.enable()
        other.close()


def test_a_fault_of_another_kind_is_reset_without_a_reset_of_the_communication() -> None:
    with bench() as made, Sniffer(made) as sniffer:
        made.emulated.fault(0x8611)
        made.clock.sleep(0.05)
        made.drive.connect()
        made.drive.reset_fault()
        assert 0x000 not in [cob_id for _, cob_id, _ in sniffer.frames]


def powered_by_a_dead_program(made: Bench, nmt: int | None) -> None:
    """The drive goes on to its target although nobody sends heartbeats."""
    made.drive.command(Target(1.5, 1.0))
    made.clock.sleep(0.5)
    assert made.emulated.state is State.OPERATION_ENABLED
    assert made.fin.now().velocity > 0
    if nmt is not None:
        with Sniffer(made) as sniffer:
            sniffer.send(protocol.NMT, bytes([nmt, NODE]))


@pytest.mark.parametrize("nmt", [None, protocol.NMT_PRE_OPERATIONAL, protocol.NMT_STOP])
def test_a_drive_that_another_program_has_powered_is_switched_off_in_any_state_of_its_node(
    nmt: int | None,
) -> None:
    with enabled(traits=IGNORES) as made:
        powered_by_a_dead_program(made, nmt)
        Epos2(made.bus, drive_config(), made.clock).switch_off()
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        assert made.fin.now().velocity == 0.0
        assert made.fin.now().angle < 1.5


def test_a_drive_is_switched_off_although_its_program_goes_on_with_its_loop() -> None:
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.command(Target(1.5, 0.5 * 3.14))
        ended = made.clock.event()

        def loop() -> None:
            while not ended.wait(0.01):
                made.drive.send_heartbeat()
                made.drive.sync_and_read(0.003)

        thread = made.clock.spawn(loop, "loop")
        made.clock.sleep(0.1)
        began = len(sniffer.frames)
        Epos2(made.bus, drive_config(), made.clock).switch_off()
        ended.set()
        thread.join()
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        # The first frame of it is the quick stop.
        words = [data[:2] for _, cob_id, data in sniffer.frames[began:] if cob_id == 0x200 + NODE]
        assert words[0] == b"\x02\x00"


def test_a_shaft_that_does_not_come_to_rest_loses_its_voltage_after_the_time_of_braking(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    read = procedures.read_optional

    def turning(connection: CanConnection, entry: Object) -> int | None:
        return 1000 if entry is protocol.VELOCITY else read(connection, entry)

    with enabled(traits=IGNORES) as made:
        powered_by_a_dead_program(made, None)
        monkeypatch.setattr(procedures, "read_optional", turning)
        began = made.clock()
        Epos2(made.bus, drive_config(), made.clock).switch_off()
        assert made.clock() - began < 2.0
        assert made.emulated.state is State.SWITCH_ON_DISABLED


def test_a_drive_at_rest_may_be_switched_off_and_one_that_does_not_answer_is_told() -> None:
    with bench() as made:
        drive = Epos2(made.bus, drive_config(), made.clock)
        drive.switch_off()
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        made.emulated.go_silent()
        began = made.clock()
        with pytest.raises(
            DeviceError, match="did not confirm that its motor is off; press the emergency stop"
        ):
            drive.switch_off()
        assert made.clock() - began < 8.0


def test_a_drive_that_is_powered_again_at_once_is_not_off() -> None:
    with enabled(traits=IGNORES) as made:
        ended = made.clock.event()

        def insist() -> None:
            while not ended.wait(0.05):
                for word in (0x06, 0x07, 0x0F):
                    with Sniffer(made) as sniffer:
                        sniffer.send(*made.drive.order(word))
                    made.clock.sleep(0.01)

        thread = made.clock.spawn(insist, "another program")
        with pytest.raises(DeviceError, match="close any other programs that control it"):
            Epos2(made.bus, drive_config(), made.clock).switch_off()
        ended.set()
        thread.join()


def test_a_program_with_exclusive_use_of_the_adapter_is_asked_to_exit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with enabled(traits=IGNORES) as made:
        powered_by_a_dead_program(made, None)
        drive = Epos2(made.bus, drive_config(), made.clock)
        open_bus = drive.connection.open
        is_in_use = True

        def open_unless_in_use() -> None:
            if is_in_use:
                raise RigError("CAN bus: cannot be opened")
            open_bus()

        def refuse(_: object) -> None:
            raise RigError("drive 1: in use by another program")

        def ask(_: object) -> bool:
            nonlocal is_in_use
            is_in_use = False
            return True

        monkeypatch.setattr(drive.connection, "open", open_unless_in_use)
        monkeypatch.setattr(drive.device_lock, "acquire", refuse)
        monkeypatch.setattr(drive.device_lock, "take_over", ask)
        drive.switch_off()
        assert made.emulated.state is State.SWITCH_ON_DISABLED
        assert made.fin.now().velocity == 0.0
