"""The drive over its emulator in simulated time: start, motion, stop, own stop and faults."""

import math
import random
import struct

import pytest

from softfin.core.dynamixel import CENTER
from softfin.core.errors import CommandError, DeviceError, RigError, SafetyStop
from softfin.emulation.dynamixel import MOUNTED_TICKS
from softfin.rig.devices.dynamixel import protocol
from softfin.rig.devices.dynamixel.config import position_range
from softfin.rig.devices.dynamixel.drive import Dynamixel
from softfin.rig.devices.dynamixel.link import NoAnswer
from softfin.rig.devices.dynamixel.protocol import (
    HardwareError,
    Instruction,
    Packet,
    Refusal,
    encode_packet,
)
from softfin.rig.machine import Target
from softfin.testing import check_drive
from tests.rig.devices.dynamixel.bench import bench, enabled, servo_config

TORQUE = protocol.TORQUE_ENABLE
WATCHDOG = protocol.BUS_WATCHDOG


def is_status(answer):
    """Tell a status from the answers to other instructions by its length."""
    return len(answer) == len(encode_packet(Packet(7, Instruction.STATUS, bytes(1)))) + (
        protocol.STATUS_LAYOUT.size
    )


@pytest.mark.parametrize("direction", [1, -1])
def test_the_servo_meets_the_contract_of_a_drive(direction):
    with bench(direction=direction) as made:
        check_drive(made.drive, made.clock)


@pytest.mark.parametrize(("model", "unit_a"), [("XM430-W350", 2.69e-3), ("XH430-V350", 1.34e-3)])
def test_readings_are_in_the_fins_units(model, unit_a):
    with enabled(model=model, direction=-1) as made:
        made.drive.command(Target(1.0, 2.0))
        made.loop(0.2)
        reading = made.drive.read()
        assert reading.angle == pytest.approx(0.4, abs=0.02)
        assert reading.velocity == pytest.approx(2.0, abs=0.03)
        assert reading.current == pytest.approx(made.fin.now().current, abs=unit_a)
        assert abs(reading.following_error) < 0.01
        assert reading.voltage == pytest.approx(12.0)
        assert made.clock() - reading.time < 0.001


def test_it_is_read_at_100_hz_with_one_instruction_per_tick():
    with enabled() as made:
        made.servo.received.clear()
        made.loop(1.0)
        assert len(made.servo.received) == 100
        assert {packet.instruction for packet in made.servo.received} == {Instruction.READ}


def test_a_target_is_sent_with_its_acceleration_and_velocity_in_one_write():
    with enabled() as made:
        made.servo.received.clear()
        made.drive.command(Target(0.5, 1.0))
        (packet,) = made.servo.received
        assert packet.instruction == Instruction.WRITE
        # 30 rad/s2 are 80 units of 214.577 rev/min2, 1 rad/s is 42 units of 0.229 rev/min, and
        # 0.5 rad are 326 of 4096 counts from the middle.
        assert packet.data == bytes.fromhex("6C00 50000000 2A000000 46090000")


def test_a_target_outside_the_limits_is_refused():
    with enabled() as made:
        for target in (Target(2.0, 1.0), Target(0.0, 9.0), Target(math.nan, 1.0)):
            with pytest.raises(CommandError):
                made.drive.command(target)
        assert made.servo.get(protocol.GOAL_POSITION) == CENTER


def test_the_ends_of_the_range_are_reached():
    limits = servo_config().limits
    with enabled() as made:
        for angle in limits[:2]:
            made.drive.command(Target(angle, math.pi))
            made.loop(1.5)
            assert made.drive.read().angle == pytest.approx(angle, abs=0.01)
        assert made.drive.complaints() == ()


def test_a_stop_brakes_along_the_quick_stop_and_then_switches_the_torque_off():
    with enabled() as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.2)
        angle = made.fin.now().angle
        made.servo.received.clear()
        made.drive.stop()
        writes = [
            int.from_bytes(packet.data[:2], "little")
            for packet in made.servo.received
            if packet.instruction == Instruction.WRITE
        ]
        assert writes == [protocol.PROFILE_ACCELERATION.address, TORQUE.address, WATCHDOG.address]
        # v^2 / (2 a)
        way = math.pi**2 / (2 * made.drive.config.quick_stop_rad_s2)
        assert made.fin.now().angle - angle == pytest.approx(way, abs=0.04)
        assert made.servo.get(TORQUE) == 0
        assert made.servo.get(WATCHDOG) == 0
        assert made.drive.stop_unconfirmed is None
        with pytest.raises(DeviceError, match="not enabled"):
            made.drive.command(Target(0.0, 1.0))


def test_the_zero_is_kept_by_the_servo_and_needed_once():
    with bench() as made:
        made.drive.open()
        assert not made.drive.referenced
        with pytest.raises(RigError, match="never been zeroed"):
            made.drive.enable()
        assert made.drive.read_angle() != pytest.approx(0.0, abs=0.05)
        made.drive.zero()
        assert made.servo.get(TORQUE) == 0
        made.drive.close()
        made.servo.power_up()
        made.drive.open()
        assert made.drive.referenced
        assert made.drive.read_angle() == pytest.approx(0.0, abs=0.002)
        made.drive.enable()


def test_a_horn_too_far_from_the_middle_cannot_be_zeroed():
    with bench() as made:
        made.drive.open()
        made.fin.move(1.5, 10.0)
        made.clock.sleep(1.0)
        with pytest.raises(RigError, match=r"horn is at 2\d\d degrees; mount the fin"):
            made.drive.zero()
        assert made.servo.get(protocol.HOMING_OFFSET) == 0


def test_an_offset_that_the_servo_ignores_is_no_zero():
    with bench() as made:
        made.servo.set(protocol.HOMING_OFFSET, 1500)
        made.drive.open()
        assert not made.drive.referenced
        with pytest.raises(RigError, match="never been zeroed"):
            made.drive.enable()
        made.drive.zero()
        assert made.drive.referenced
        assert made.drive.read_angle() == pytest.approx(0.0, abs=0.002)


def test_an_offset_that_the_servo_ignores_does_not_shift_its_targets():
    with bench(zero_needed=False) as made:
        made.servo.set(protocol.HOMING_OFFSET, 1500)
        made.drive.open()
        made.drive.enable()
        made.drive.command(Target(0.5, 1.0))
        made.loop(1.0)
        assert made.drive.read().angle == pytest.approx(0.5, abs=0.02)


def test_a_zero_that_failed_is_no_zero(monkeypatch):
    with bench() as made:
        made.drive.open()
        place = made.servo._position
        monkeypatch.setattr(
            made.servo,
            "_position",
            lambda angle: place(angle) + 137 * bool(made.servo.get(protocol.HOMING_OFFSET)),
        )
        with pytest.raises(DeviceError, match="after zeroing instead of 2048"):
            made.drive.zero()
        assert made.servo.get(protocol.HOMING_OFFSET) == 0
        assert not made.drive.referenced


def test_a_zero_that_was_not_checked_is_no_zero():
    with bench() as made:
        made.drive.open()
        made.servo.transmit = lambda answer: (
            () if is_status(answer) and made.servo.get(protocol.HOMING_OFFSET) else (answer,)
        )
        with pytest.raises(DeviceError, match=r"no usable response|does not respond"):
            made.drive.zero()
        assert made.servo.get(protocol.HOMING_OFFSET) == 0
        assert not made.drive.referenced


def test_a_fin_outside_its_range_is_not_powered():
    with bench(zero_needed=False) as made:
        made.fin.move(1.7, 10.0)
        made.clock.sleep(1.0)
        made.drive.open()
        with pytest.raises(RigError, match=r"fin is at 1\.\d+ rad, outside"):
            made.drive.enable()
        assert made.servo.get(TORQUE) == 0


def test_a_fin_outside_the_servos_limits_is_not_powered():
    with bench(zero_needed=False) as made:
        for entry, limit in zip(
            (protocol.MIN_POSITION_LIMIT, protocol.MAX_POSITION_LIMIT),
            position_range(made.drive.config),
            strict=True,
        ):
            made.servo.set(entry, limit)
        made.servo.set(protocol.HOMING_OFFSET, -MOUNTED_TICKS)
        made.fin.move(1.65, 10.0)
        made.clock.sleep(1.0)
        made.drive.open()
        with pytest.raises(RigError, match=r"fin is at 1\.6\d+ rad, .*; turn it back by hand"):
            made.drive.enable()
        assert made.servo.get(TORQUE) == 0
        made.fin.move(1.5, 10.0)
        made.clock.sleep(1.0)
        made.drive.enable()


@pytest.mark.parametrize("heartbeat_s", [0.1, 0.15, 1.0])
def test_a_servo_whose_host_dies_stops_by_itself(heartbeat_s):
    with enabled(heartbeat_s=heartbeat_s, quick_stop_rad_s2=80.0, angle_max_rad=2.5) as made:
        made.drive.command(Target(2.5, 1.0 if heartbeat_s > 0.5 else math.pi))
        made.loop(0.1)
        died = made.clock()
        while made.fin.now().velocity:
            made.clock.sleep(0.001)
        # The servo's own stop at the latest after `heartbeat_s`, and v / a.
        assert made.clock() - died <= heartbeat_s + math.pi / 80.0
        assert made.fin.now().angle < 2.4
        assert made.servo.get(WATCHDOG) == protocol.WATCHDOG_TRIPPED
        # It holds its position: only a new program switches it off.
        assert made.servo.get(TORQUE) == 1


def test_a_host_that_hangs_is_told_and_its_servo_must_be_acknowledged():
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.clock.sleep(0.3)
        made.drive.read()
        assert "stopped by its bus watchdog" in made.drive.complaints()[0]
        made.drive.link.close()
        other = Dynamixel(made.drive.config, made.clock)
        with pytest.raises(
            RigError, match=r"bus watchdog, .*; then run: softfin rig check --reset"
        ):
            other.open()
        other.connect()
        assert "bus watchdog" in other.reset_fault()
        assert made.servo.get(TORQUE) == 0
        assert other.reset_fault() is None
        other.close()
        other.open()
        other.enable()
        other.close()


def test_its_own_stop_is_proved_without_motion():
    with bench() as made:
        with pytest.raises(DeviceError, match="drive is not open"):
            made.drive.prove_stop()
        made.drive.open()
        assert 0.1 <= made.drive.prove_stop() <= 0.15
        assert made.fin.now().angle == pytest.approx(0.0, abs=0.002)
        assert made.servo.get(TORQUE) == 0
        assert made.drive.complaints() == ()


def test_a_servo_without_a_watchdog_is_found_and_stopped():
    with bench() as made:
        made.drive.open()
        made.servo.is_watchdog_broken = True
        with pytest.raises(DeviceError, match="servo ignores missing instructions from softfin"):
            made.drive.prove_stop()
        assert made.servo.get(TORQUE) == 0


@pytest.mark.parametrize(
    ("error", "words", "is_off"),
    [
        (HardwareError.OVERLOAD, "overload: check for a blocked fin", True),
        (HardwareError.OVERHEATING, "overheating: let the servo cool down", True),
        (HardwareError.ELECTRICAL_SHOCK, "electrical shock: check for a short circuit", True),
        (HardwareError.INPUT_VOLTAGE, "input voltage: check the supply", False),
        (HardwareError.MOTOR_ENCODER, "motor encoder: restart the servo", False),
    ],
)
def test_a_hardware_error_is_told_stopped_and_reset(error, words, is_off):
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.loop(0.1)
        made.servo.trip(error)
        made.drive.read()
        assert words in made.drive.complaints()[0]
        assert (made.servo.get(TORQUE) == 0) == is_off
        made.drive.stop()
        assert made.servo.get(TORQUE) == 0
        with pytest.raises(DeviceError, match="hardware error"):
            made.drive.enable()
        made.drive.close()
        with pytest.raises(RigError, match=r"hardware error .*; then run: softfin rig check"):
            made.drive.open()
        made.drive.connect()
        assert words in made.drive.reset_fault()
        made.drive.close()
        made.drive.open()
        made.drive.enable()


def test_a_fault_whose_cause_remains_is_not_reset():
    with bench() as made:
        made.servo.trip(HardwareError.INPUT_VOLTAGE)
        power_up = made.servo.power_up

        def again():
            power_up()
            made.servo.trip(HardwareError.INPUT_VOLTAGE)

        made.servo.power_up = again
        made.drive.connect()
        with pytest.raises(DeviceError, match="still in fault"):
            made.drive.reset_fault()


@pytest.mark.parametrize("offset", [300, -800])
def test_a_servo_that_moves_when_it_should_stop_gets_no_proof(offset):
    """The firmware fault of DynamixelSDK issue 584."""
    with bench(zero_needed=False) as made:
        made.servo.ignores_offset = True
        made.drive.open()
        assert 0.1 <= made.drive.prove_stop() <= 0.15, "without an offset there is no fault"
        made.drive.close()
        made.servo.set(protocol.HOMING_OFFSET, offset)
        made.drive.open()
        assert made.drive.identity["homing_offset"] == offset
        with pytest.raises(DeviceError, match=r"servo: turned the fin by [+-]\d\.\d\d rad during"):
            made.drive.prove_stop()
        assert made.servo.get(TORQUE) == 0


def test_a_servo_that_moves_shortly_after_its_stop_gets_no_proof():
    with bench(zero_needed=False) as made:
        made.drive.open()
        watch = made.servo._watch

        def move_later(now):
            watch(now)
            is_late = now - made.servo._instruction_time > 0.0
            if made.servo.get(WATCHDOG) == protocol.WATCHDOG_TRIPPED and is_late:
                made.fin.move(0.2, 0.5)

        made.servo._watch = move_later
        with pytest.raises(DeviceError, match="servo: turned the fin by"):
            made.drive.prove_stop()


def test_a_proof_is_rejected_if_the_computer_pauses_during_it(monkeypatch):
    with bench(zero_needed=False) as made:
        made.drive.open()
        sleep = made.clock.sleep
        monkeypatch.setattr(
            made.clock, "sleep", lambda seconds: sleep(seconds if seconds < 0.05 else 2.0)
        )
        with pytest.raises(DeviceError, match=r"paused for 2\.0 s during the stop test"):
            made.drive.prove_stop()
        assert made.servo.get(TORQUE) == 0


def test_a_pause_of_the_program_is_reported_as_a_pause():
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.clock.sleep(0.12)
        made.drive.command(Target(-1.5, 1.0))
        (line,) = made.drive.complaints()
        assert "stopped by its bus watchdog, because instructions were missing" in line
        made.loop(0.02)
        assert made.drive.complaints() == (line,)


def test_a_watchdog_that_another_program_switches_off_is_a_fault():
    with enabled() as made:
        made.drive.command(Target(1.4, 1.0))
        made.loop(0.1)
        assert made.drive.complaints() == ()
        made.servo.set(WATCHDOG, 0)
        made.loop(0.02)
        (line,) = made.drive.complaints()
        assert line.startswith("servo setting Bus Watchdog (98) is 0 instead of 4, so")


@pytest.mark.parametrize("delay_s", [0.008, 0.016, 0.03])
def test_a_stop_with_late_answers_neither_reverses_the_fin_nor_is_unconfirmed(delay_s):
    with enabled() as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.2)
        made.servo.delay_s = delay_s
        made.loop(0.05)
        start = highest = made.fin.now().angle
        thread = made.clock.spawn(made.drive.stop, "stop")
        while thread.is_alive() or made.fin.now().velocity:
            made.clock.sleep(0.001)
            angle = made.fin.now().angle
            assert angle > highest - 0.03
            highest = max(highest, angle)
        # One missed answer at 3.14 rad/s, and v^2 / (2 a).
        assert highest - start < 0.15
        assert made.servo.get(TORQUE) == 0
        assert made.drive.stop_unconfirmed is None


def test_a_silent_servo_is_told_and_its_stop_is_unconfirmed():
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.loop(0.1)
        before = made.drive.read().time
        made.servo.silence()
        made.loop(0.15)
        assert made.drive.read().time == before
        assert "no usable response for 0.2" in made.drive.complaints()[0]
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 2.0
        assert "press the emergency stop" in made.drive.stop_unconfirmed
        # Its own watchdog has stopped it.
        assert made.fin.now().velocity == 0.0
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 0.2
        made.servo.silence(0.0)
        made.drive.stop()
        assert made.drive.stop_unconfirmed is None
        assert made.servo.get(TORQUE) == 0


def test_a_servo_that_ignores_a_stop_is_left_to_its_watchdog(monkeypatch):
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.loop(0.1)
        monkeypatch.setattr(made.servo, "_write", lambda request: None)
        made.drive.stop()
        assert made.drive.stop_unconfirmed
        assert made.fin.now().velocity > 0
        # The loop may go on.
        made.loop(0.15)
        assert made.servo.get(WATCHDOG) == protocol.WATCHDOG_TRIPPED
        assert made.fin.now().velocity == 0
        assert made.fin.now().angle < 1.4


def test_a_lost_answer_is_counted_and_nothing_else():
    with enabled() as made:
        lost = iter([()])
        made.servo.transmit = lambda answer: next(lost, (answer,))
        made.loop(0.05)
        assert made.drive.counters()["answers missing"] == 1
        assert made.drive.complaints() == ()
        assert made.clock() - made.drive.read().time < 0.01


def garbled(answer):
    return (answer[:-1] + bytes([answer[-1] ^ 1]),)


def test_garbled_answers_are_counted_and_told():
    with enabled() as made:
        angle = made.drive.read().angle
        made.servo.transmit = garbled
        made.loop(0.15)
        assert made.drive.counters()["crc errors"] >= 15
        assert made.drive.read().angle == angle
        assert "no usable response" in made.drive.complaints()[0]


def test_nonsense_and_foreign_packets_between_answers_do_no_harm():
    foreign = encode_packet(Packet(8, Instruction.STATUS, bytes(26)))
    echo = encode_packet(Packet(7, Instruction.READ, bytes(26)))
    with enabled() as made:
        made.servo.transmit = lambda answer: (b"\x00\xff\xff\xfd", foreign + echo, answer)
        made.drive.command(Target(1.0, 1.0))
        made.loop(0.5)
        assert made.drive.read().angle == pytest.approx(0.5, abs=0.02)
        assert made.drive.complaints() == ()


@pytest.mark.parametrize("delay_s", [0.009, 0.012, 0.015, 0.025])
def test_a_late_answer_is_never_taken_for_a_new_one(delay_s):
    with enabled() as made:
        made.drive.command(Target(1.5, 1.0))
        made.loop(0.1)
        made.servo.delay_s = delay_s
        for _ in range(15):
            made.clock.sleep(0.01)
            reading = made.drive.read()
            # The fin turns with 1 rad/s.
            age_s = made.fin.now().angle - reading.angle
            assert age_s <= made.clock() - reading.time + 0.005
        assert made.drive.complaints()


def test_a_target_that_is_lost_is_repeated_and_one_that_is_never_taken_is_told(monkeypatch):
    with enabled() as made:
        write = made.servo._write
        lost = [2]

        def deaf(request):
            if request[0] == protocol.PROFILE_ACCELERATION.address and lost[0]:
                lost[0] -= 1
                return None
            return write(request)

        monkeypatch.setattr(made.servo, "_write", deaf)
        made.drive.command(Target(0.5, 1.0))
        made.loop(0.1)
        assert made.drive.counters()["targets repeated"] == 2
        assert made.servo.get(protocol.GOAL_POSITION) != CENTER
        lost[0] = 100
        made.drive.command(Target(-0.5, 1.0))
        made.loop(0.05)
        assert "did not accept a target" in made.drive.complaints()[0]


def test_a_target_that_the_servo_refuses_is_told():
    with enabled() as made:
        made.servo.set(protocol.MAX_POSITION_LIMIT, 2100)
        made.drive.command(Target(0.5, 1.0))
        assert "refused a target (error 6, data limit)" in made.drive.complaints()[0]


def test_a_servo_that_restarts_is_told():
    with enabled() as made:
        made.servo.power_up()
        made.drive.read()
        assert "servo restarted; check its supply" in made.drive.complaints()[0]
        made.drive.stop()
        assert made.servo.get(TORQUE) == 0


def test_a_motor_that_another_program_switches_off_is_told():
    with enabled() as made:
        made.servo.set(TORQUE, 0)
        made.drive.read()
        assert "motor is off although it was enabled" in made.drive.complaints()[0]


def test_a_port_that_is_unplugged_is_told():
    with enabled() as made:
        made.drive.link._port.close()
        made.drive.read()
        assert "port cannot be used" in made.drive.complaints()[0]
        made.drive.stop()
        assert made.drive.stop_unconfirmed


def test_a_missing_servo_is_told():
    with bench() as made:
        made.servo.silence()
        with pytest.raises(RigError, match="simulated: no servo with ID 7 "):
            made.drive.open()


def test_another_model_is_refused():
    with bench() as made:
        made.servo.set(protocol.MODEL_NUMBER, 1030)
        with pytest.raises(RigError, match=r"model number is 1030 \(XM430-W210\), but XM430-W350"):
            made.drive.open()
        made.servo.set(protocol.MODEL_NUMBER, 29)
        with pytest.raises(RigError, match=r"model number is 29 \(unsupported\)"):
            made.drive.open()


def test_a_firmware_without_a_watchdog_is_refused():
    with bench() as made:
        made.servo.set(protocol.FIRMWARE_VERSION, 37)
        with pytest.raises(RigError, match="firmware 37 has no bus watchdog"):
            made.drive.open()


def test_two_servos_with_one_id_are_noticed():
    """Both answer at once: a bit of the line is 0 if one of them sends 0."""
    with bench() as made:

        def both(answer):
            # The other has the same model and firmware, but another clock and angle.
            other = bytearray(answer)
            if len(answer) > 20:
                other[16] ^= 0x35
                other[24] ^= 0x11
            return (bytes(a & b for a, b in zip(answer, other, strict=True)),)

        made.servo.transmit = both
        with pytest.raises(DeviceError, match="that no second servo has its ID"):
            made.drive.open()


@pytest.mark.parametrize(
    ("entry", "value", "words"),
    [
        (protocol.OPERATING_MODE, 4, "Operating Mode .* is 4: .* set it to 3"),
        (protocol.STARTUP_CONFIGURATION, 1, "power its motor or restore old settings; set it to 0"),
        (protocol.STARTUP_CONFIGURATION, 2, "power its motor or restore old settings; set it to 0"),
        (protocol.OPERATING_MODE, 1, "Operating Mode .* is 1: .* set it to 3"),
        (protocol.DRIVE_MODE, 8, "Drive Mode .* is 8: .*set it to 0"),
        (protocol.DRIVE_MODE, 1, "Drive Mode .* is 1: .*drive.direction"),
        (protocol.SHUTDOWN_ERRORS, 0, "Shutdown .* is 0: .*set it to 52"),
        (
            protocol.MAX_POSITION_LIMIT,
            4095,
            "Max Position Limit .* is 4095: .* set the servo to 3170",
        ),
        (protocol.MAX_POSITION_LIMIT, 2500, "Max Position Limit .* is 2500"),
        (protocol.MIN_POSITION_LIMIT, 0, "Min Position Limit .* is 0: .* set the servo to 926"),
        (protocol.VELOCITY_LIMIT, 350, "Velocity Limit .* is 350: .* set the servo to 131"),
    ],
)
def test_a_servo_that_is_set_up_differently_is_refused(entry, value, words):
    with bench() as made:
        made.servo.set(entry, value)
        with pytest.raises(RigError, match=words):
            made.drive.open()
        assert made.servo.get(entry) == value


@pytest.mark.parametrize("level", [0, 1, 2])
def test_a_servo_that_does_not_answer_everything_is_made_to(level):
    with bench() as made:
        made.servo.set(protocol.STATUS_RETURN_LEVEL, level)
        made.drive.open()
        made.drive.zero()
        made.drive.enable()
        assert made.servo.get(protocol.STATUS_RETURN_LEVEL) == 2


def test_a_slow_adapter_is_refused():
    with bench() as made:
        made.servo.delay_s = 0.016
        with pytest.raises(RigError, match=r"responses take 16 ms.*latency timer"):
            made.drive.open()


def test_a_request_delayed_by_a_busy_computer_does_not_make_later_answers_late(monkeypatch):
    with bench() as made:
        pauses_s = [0.02]
        read_bytes = made.drive.link.read_bytes

        def delayed(address, *rest):
            if address == protocol.INDIRECT_DATA and pauses_s:
                made.clock.sleep(pauses_s.pop())
            return read_bytes(address, *rest)

        monkeypatch.setattr(made.drive.link, "read_bytes", delayed)
        made.drive.open()
        assert pauses_s == []
        assert made.drive.counters() == {}


def test_a_servo_with_unusable_answers_is_refused():
    with bench() as made:
        made.servo.transmit = lambda answer: () if is_status(answer) else (answer,)
        with pytest.raises(DeviceError, match="only 0 of 20 responses are usable; check its cable"):
            made.drive.open()


def test_a_servo_that_is_powered_is_refused_and_switched_off():
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.1)
        other = Dynamixel(made.drive.config, made.clock)
        with pytest.raises(RigError, match="already powered; close the program"):
            other.open()
        angle = made.fin.now().angle
        other.switch_off()
        assert made.servo.get(TORQUE) == 0
        assert made.fin.now().velocity == 0.0
        assert made.fin.now().angle - angle < 0.4


def test_a_foreign_servos_velocity_and_position_are_read_at_the_same_time():
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.1)
        made.servo.received.clear()
        Dynamixel(made.drive.config, made.clock).switch_off()
        reads = {
            struct.unpack("<HH", packet.data)
            for packet in made.servo.received
            if packet.instruction == Instruction.READ
        }
        assert (protocol.PRESENT_VELOCITY.address, 8) in reads
        assert (protocol.PRESENT_POSITION.address, 4) not in reads


def test_a_foreign_servo_outside_its_range_gets_no_goal():
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.3)
        assert made.fin.now().angle > 0.5
        config = made.drive.config.model_copy(update={"angle_max_rad": 0.2})
        made.servo.received.clear()
        Dynamixel(config, made.clock).switch_off()
        assert made.servo.get(TORQUE) == 0
        assert written(made.servo) == {TORQUE.address, protocol.STATUS_RETURN_LEVEL.address}


def written(servo):
    return {
        int.from_bytes(packet.data[:2], "little")
        for packet in servo.received
        if packet.instruction == Instruction.WRITE
    }


@pytest.mark.parametrize("level", [0, 1])
def test_a_servo_that_answers_little_is_braked_and_switched_off(level):
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.1)
        made.servo.set(protocol.STATUS_RETURN_LEVEL, level)
        angle = made.fin.now().angle
        Dynamixel(made.drive.config, made.clock).switch_off()
        assert made.servo.get(TORQUE) == 0
        # One missing answer later than a servo that answers everything.
        assert made.fin.now().angle - angle < 0.5


def test_switch_off_works_if_another_program_receives_half_of_the_answers(monkeypatch):
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.1)
        other = Dynamixel(made.drive.config, made.clock)
        monkeypatch.setattr(other.device_lock, "take_over", lambda _: False)
        transact = other.link._transact
        chance = random.Random(0)

        def lose_answers(*request):
            if chance.random() < 0.5:
                raise DeviceError("port cannot be used (multiple access on port?)")
            return transact(*request)

        monkeypatch.setattr(other.link, "_transact", lose_answers)
        angle = made.fin.now().angle
        other.switch_off()
        assert made.servo.get(TORQUE) == 0
        # It coasts at 10 rad/s2.
        assert made.fin.now().angle - angle < 0.6


def deaf(monkeypatch, drive, is_deaf=lambda: True):
    """Let a second program take the answers of a drive and keep its port."""
    transact = drive.link._transact

    def lose(*request):
        answer = transact(*request)
        if is_deaf():
            raise NoAnswer("no answer")
        return answer

    monkeypatch.setattr(drive.link, "_transact", lose)
    monkeypatch.setattr(drive.device_lock, "take_over", lambda _: False)


def test_without_answers_the_torque_goes_off_and_is_reported_as_unconfirmed(monkeypatch):
    with enabled(heartbeat_s=1.0) as made:
        made.drive.command(Target(1.5, 1.0))
        made.loop(0.1)
        other = Dynamixel(made.drive.config, made.clock)
        deaf(monkeypatch, other)
        made.servo.received.clear()
        with pytest.raises(DeviceError, match="did not confirm that its motor is off"):
            other.switch_off()
        assert made.servo.get(TORQUE) == 0
        # Braking needs answers, and would delay the stop.
        writes = {int.from_bytes(packet.data[:2], "little") for packet in made.servo.received}
        assert writes == {TORQUE.address}


def test_a_motor_is_not_off_if_the_last_answers_are_missing(monkeypatch):
    with bench() as made:
        other = Dynamixel(made.drive.config, made.clock)
        confirmed = []
        deaf(monkeypatch, other, lambda: len(confirmed) > 3)
        is_powered = other._is_powered

        def ask(*answer_s):
            confirmed.append(is_powered(*answer_s))
            return confirmed[-1]

        monkeypatch.setattr(other, "_is_powered", ask)
        with pytest.raises(DeviceError, match="did not confirm that its motor is off"):
            other.switch_off()


def test_a_stop_without_a_new_status_leaves_a_fin_at_its_goal():
    with enabled(quick_stop_rad_s2=30.0) as made:
        made.drive.command(Target(0.5, math.pi))
        made.loop(0.1)
        made.servo.transmit = lambda answer: () if is_status(answer) else (answer,)
        made.clock.sleep(0.07)
        assert made.fin.now().angle == pytest.approx(0.5, abs=0.01)
        made.drive.stop()
        assert made.fin.now().angle == pytest.approx(0.5, abs=0.01)
        assert made.drive.stop_unconfirmed is None


def test_a_stop_from_an_old_status_is_corrected_by_the_next_one():
    with enabled() as made:
        made.drive.command(Target(1.5, math.pi))
        made.drive.read()
        # The statuses end before the fin, which accelerates, has any velocity.
        made.drive.status = made.drive.status._replace(velocity=0)
        made.clock.sleep(0.06)
        lost = iter([True])
        made.servo.transmit = lambda answer: (
            () if is_status(answer) and next(lost, False) else (answer,)
        )
        highest = made.fin.now().angle
        thread = made.clock.spawn(made.drive.stop, "stop")
        while thread.is_alive() or made.fin.now().velocity:
            made.clock.sleep(0.001)
            angle = made.fin.now().angle
            # This fin has no mass: it turns back until the next status, and brakes from there.
            assert angle > highest - 0.13
            highest = max(highest, angle)
        assert made.drive.stop_unconfirmed is None


def test_a_stop_without_a_new_status_after_a_new_target_switches_the_torque_off_at_once():
    with enabled() as made:
        made.drive.command(Target(1.5, math.pi))
        made.loop(0.1)
        # The fin turns round after the latest status.
        made.drive.command(Target(-1.5, math.pi))
        made.clock.sleep(0.06)
        angle = made.fin.now().angle
        made.servo.transmit = lambda answer: () if is_status(answer) else (answer,)
        made.servo.received.clear()
        made.drive.stop()
        assert made.servo.get(TORQUE) == 0
        assert made.drive.stop_unconfirmed is None
        assert protocol.PROFILE_ACCELERATION.address not in written(made.servo)
        assert made.fin.now().angle <= angle


def test_a_servo_that_is_powered_again_or_silent_is_not_off():
    with bench() as made:
        ended = made.clock.event()

        def insist():
            while not ended.is_set():
                made.servo.set(TORQUE, 1)
                made.clock.sleep(0.02)

        thread = made.clock.spawn(insist, "another program")
        with pytest.raises(DeviceError, match="close any other programs that control it"):
            made.drive.switch_off()
        ended.set()
        thread.join()
        made.servo.silence()
        with pytest.raises(DeviceError, match="press the emergency stop"):
            made.drive.switch_off()


def test_a_servo_whose_stop_was_not_confirmed_is_switched_off_when_it_is_opened_again():
    with enabled() as made:
        made.servo.silence()
        made.drive.close()
        assert made.drive.stop_unconfirmed
        made.servo.silence(0.0)
        assert made.servo.get(TORQUE) == 1
        with pytest.raises(RigError, match="stopped by its bus watchdog"):
            made.drive.open()
        assert made.servo.get(TORQUE) == 0
        assert made.drive.stop_unconfirmed is None
        made.drive.open()


def test_a_stop_from_another_thread_ends_an_enabling():
    with bench(zero_needed=False) as made:
        made.drive.open()
        with pytest.raises(DeviceError, match="stopped while it was being enabled"):
            made.drive.enable(meanwhile=made.drive.stop)
        assert made.servo.get(TORQUE) == 0


def test_a_torque_that_does_not_go_on_is_an_error(monkeypatch):
    with bench(zero_needed=False) as made:
        made.drive.open()
        monkeypatch.setattr(made.servo, "_write", lambda request: Refusal.RESULT_FAIL)
        with pytest.raises(DeviceError, match=r"refused Bus Watchdog \(98\) \(error 1"):
            made.drive.enable()
        assert made.servo.get(TORQUE) == 0


def test_a_proof_whose_stop_is_unconfirmed_warns_the_operator():
    with bench() as made:
        made.drive.open()
        made.clock.spawn(lambda: (made.clock.sleep(0.05), made.servo.silence()), "cut")
        with pytest.raises(SafetyStop, match="BUT drive did not confirm"):
            made.drive.prove_stop()


def test_a_servo_may_be_closed_at_any_time():
    with bench() as made:
        made.drive.close()
        assert made.drive.complaints() == ()
        assert made.drive.counters() == {}
        with pytest.raises(DeviceError, match="not open"):
            made.drive.read()
