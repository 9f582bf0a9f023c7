"""Frames of chance, at the driver and at the emulator: no error, no motion, no hang."""

import os
import random
import struct

from softfin.rig.devices.epos2.protocol import POWERED
from softfin.rig.machine import Target
from softfin.rig.safety import OVERSHOOT_RAD
from tests.rig.devices.epos2.bench import NODE, Sniffer, bench, enabled

CASES = 100_000 if os.environ.get("SOFTFIN_LONG") == "1" else 3_000
BATCH = 200


def frame(chance: random.Random) -> tuple[int, bytes]:
    functions = (0x000, 0x080, 0x180, 0x280, 0x380, 0x480, 0x580, 0x700)
    cob_id = chance.choice(functions) + NODE if chance.random() < 0.7 else chance.randrange(0x800)
    return cob_id, chance.randbytes(chance.randrange(9))


def test_no_frame_moves_an_enabled_drive_that_was_asked_for_nothing() -> None:
    chance = random.Random(1)
    with enabled() as made, Sniffer(made) as sniffer:
        # What only the host would send would be another program's doing, not the driver's.
        ours = (0x000, 0x080, 0x200 + NODE, 0x300 + NODE, 0x600 + NODE)
        for _ in range(CASES // BATCH):
            for _ in range(BATCH):
                cob_id, data = frame(chance)
                if cob_id not in ours:
                    sniffer.send(cob_id, data)
            made.clock.sleep(0.0)
            made.drive.send_heartbeat()
            made.drive.sync_and_read(0.01)
            assert all("\n" not in line for line in made.drive.complaints())
        assert 0x003F not in sniffer.controlwords()
        assert made.fin.now().angle == 0.0
        began = made.clock()
        made.drive.stop()
        assert made.clock() - began < 1.0
        assert made.emulated.state not in POWERED


def test_frames_of_chance_do_not_keep_a_target_from_being_the_one_commanded() -> None:
    chance = random.Random(2)
    with enabled() as made, Sniffer(made) as sniffer:
        made.drive.command(Target(0.2, 3.0))
        for _ in range(100):
            cob_id, data = frame(chance)
            if cob_id & 0x780 in {0x180, 0x280, 0x380}:
                sniffer.send(cob_id, data)
        made.until(lambda: made.fin.now().velocity == 0.0)
        assert -1e-3 < made.fin.now().angle < 0.2 + 1e-3


def test_no_process_data_of_chance_move_an_enabled_drive_beyond_its_limits() -> None:
    chance = random.Random(4)
    with enabled(heartbeat_s=1.0) as made, Sniffer(made) as sniffer:
        reach = made.drive.config.angle_max_rad + OVERSHOOT_RAD + 1e-3
        moved = 0
        for case in range(CASES):
            word = chance.choice((0x0F, 0x1F, 0x3F, 0x0006, 0x0007, chance.randrange(0x10000)))
            near = chance.random() < 0.5
            target = (
                chance.randrange(-40_000, 40_000) if near else chance.randrange(-(2**31), 2**31)
            )
            sniffer.send(0x300 + NODE, chance.randbytes(4))
            sniffer.send(0x200 + NODE, struct.pack("<Hi", word, target))
            if case % 20 == 0:
                made.clock.sleep(0.02)
                made.drive.send_heartbeat()
                motion = made.fin.now()
                moved += motion.velocity != 0.0
                # A drive that faults at its limits is reset by chance, and goes on.
                assert abs(motion.angle) <= reach
        assert moved > 0


def test_no_frame_moves_or_ends_the_emulated_drive() -> None:
    chance = random.Random(3)
    with bench() as made, Sniffer(made) as sniffer:
        for case in range(CASES):
            if case % BATCH == 0:
                made.clock.sleep(0.0)
            cob_id, data = frame(chance)
            sniffer.send(cob_id, data)
            if chance.random() < 0.2:
                sniffer.send(0x600 + NODE, chance.randbytes(chance.randrange(9)))
            assert made.fin.now().angle == 0.0
        made.clock.sleep(0.0)
        made.emulated.reboot()
        made.drive.open()
        assert made.drive.complaints() == ()
