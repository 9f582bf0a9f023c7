"""Several fins on one bus, each with a program of its own: one that dies must not be kept moving by
the others."""

from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from typing import NamedTuple

import can
import pytest

from softfin.core.errors import RigError
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2 import motor as emulated_motor
from softfin.emulation.epos2.drive import USUAL, DriveTraits, EmulatedDrive
from softfin.rig.bus import BusConfig
from softfin.rig.devices.epos2 import protocol
from softfin.rig.devices.epos2.drive import Epos2
from softfin.rig.devices.epos2.protocol import FAULT_STATES, State
from softfin.rig.machine import Target
from tests.rig.devices.epos2.bench import bus_config, drive_config
from tests.rig.simple_fin import SimpleFin

HEARTBEAT_S = 0.2


class Host:
    """A program with a drive and a fin; its loop runs in a thread until it is killed."""

    def __init__(
        self, bus: BusConfig, clock: SimulatedClock, node: int, traits: DriveTraits
    ) -> None:
        config = drive_config(node=node, heartbeat_s=HEARTBEAT_S)
        self.fin = SimpleFin(clock)
        self.emulated = EmulatedDrive(bus, config, self.fin, clock, traits)
        self.drive = Epos2(bus, config, clock)
        self.killed = clock.event()
        self._clock = clock

    def swim(self) -> None:
        self.drive.open()
        self.drive.zero()
        self.drive.enable()
        self._clock.spawn(self._loop, "host")

    def _loop(self) -> None:
        while not self.killed.wait(0.01):
            self.drive.send_heartbeat()
            self.drive.sync_and_read(0.003)

    def close(self) -> None:
        self.killed.set()
        self._clock.sleep(0.05)
        self.drive.close()
        self.emulated.close()


class Shoal(NamedTuple):
    hosts: list[Host]
    bus: BusConfig
    clock: SimulatedClock


@contextmanager
def shoal(count: int, traits: DriveTraits = USUAL) -> Iterator[Shoal]:
    clock = SimulatedClock()
    bus = bus_config()
    with ExitStack() as stack:
        hosts = [
            stack.enter_context(closing(Host(bus, clock, node, traits)))
            for node in range(1, count + 1)
        ]
        yield Shoal(hosts, bus, clock)


@pytest.mark.parametrize("count", [2, 4])
def test_the_fin_of_a_host_that_dies_stands_and_the_others_swim_on(count: int) -> None:
    with shoal(count) as made:
        for host in made.hosts:
            host.swim()
        for host in made.hosts:
            host.drive.command(Target(0.8, 1.0))
        made.clock.sleep(0.1)
        dead, *others = made.hosts
        dead.killed.set()
        made.clock.sleep(HEARTBEAT_S + 0.1)
        stopped_at = dead.fin.now().angle
        assert dead.emulated.state in FAULT_STATES
        assert dead.fin.now().velocity == 0.0
        assert stopped_at < 0.1 + HEARTBEAT_S + 0.1
        made.clock.sleep(0.7)
        assert dead.fin.now().angle == stopped_at
        for host in others:
            assert host.emulated.state is State.OPERATION_ENABLED
            assert host.fin.now().angle == pytest.approx(0.8, abs=1e-3)
            assert host.drive.complaints() == ()


def process_data_per_second(made: Shoal) -> float:
    seconds = 0.3
    bus = made.clock.open_bus(made.bus)
    made.clock.sleep(seconds)
    frames = []
    while message := bus.recv(0.0):
        frames.append(message.arbitration_id & 0x780)
    bus.shutdown()
    return sum(function in protocol.TPDO for function in frames) / seconds / len(made.hosts)


def test_a_drive_answers_its_own_host_alone() -> None:
    rates = []
    for count in (1, 4):
        with shoal(count) as made:
            for host in made.hosts:
                host.swim()
            rates.append(process_data_per_second(made))
    # Three process data at each of 100 SYNCs; the wait for the answers makes a tick of the loop a
    # little longer.
    assert rates[0] == pytest.approx(300, rel=0.05)
    assert rates[1] == pytest.approx(rates[0], rel=0.02)


def test_a_second_host_with_the_same_number_or_drive_is_refused_before_it_sends_anything() -> None:
    with shoal(1) as made:
        made.hosts[0].swim()
        for changes, words in (
            ({"node": 1}, r"the node number of this program, 126, is in use .* drive\.host_node"),
            ({"node": 7, "host_node": 126}, "the node number of this program, 126, is in use"),
        ):
            bus = made.clock.open_bus(made.bus)
            second = Epos2(made.bus, drive_config(**changes), made.clock)
            with pytest.raises(RigError, match=words):
                second.open()
            sent = []
            while message := bus.recv(0.0):
                sent.append(message.arbitration_id)
            assert not set(sent) & {0x000, 0x600 + 1, 0x600 + 7, 0x200 + 1, 0x200 + 7}
            bus.shutdown()
        made.hosts[0].drive.command(Target(0.3, 3.0))
        made.clock.sleep(0.5)
        assert made.hosts[0].fin.now().angle == pytest.approx(0.3, abs=1e-3)


def test_another_program_that_moves_our_drive_is_refused() -> None:
    with shoal(1) as made:
        host = made.hosts[0]
        host.swim()

        def command() -> None:
            while not host.killed.wait(0.05):
                host.drive.command(Target(0.3, 3.0))

        made.clock.spawn(command, "commands")
        second = Epos2(made.bus, drive_config(node=1, host_node=99), made.clock)
        with pytest.raises(RigError, match="another program is using drive 1; close it"):
            second.open()


@pytest.mark.parametrize("has_object", [True, False], ids=["read-only", "missing"])
def test_drives_that_keep_the_shared_sync_are_noted_and_refuse_to_share_a_bus(
    has_object: bool,
) -> None:
    entry = frozenset({protocol.SYNC_ID})
    traits = DriveTraits(read_only=entry) if has_object else DriveTraits(missing=entry)
    with shoal(2, traits) as made:
        first, second = made.hosts
        first.swim()
        assert first.drive.sync_id == 0x080
        assert first.drive.notes == (
            "drive responds to the SYNC of every program; connect each fin to its own bus",
        )
        first.drive.command(Target(0.2, 3.0))
        made.clock.sleep(0.5)
        assert first.fin.now().angle == pytest.approx(0.2, abs=1e-3)
        with pytest.raises(
            RigError,
            match="sends the SYNC that this drive responds to; connect each fin to its own bus",
        ):
            second.drive.open()


def test_a_drive_may_take_as_long_to_enable_on_a_busy_bus_as_on_a_quiet_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with shoal(1) as made:
        host = made.hosts[0]
        bus = made.clock.open_bus(made.bus)
        next_state = emulated_motor.next_state
        powered_at = made.clock() + 1.0

        def power_up_slowly(state: State, word: int, before: int) -> State:
            is_early = state is State.SWITCHED_ON and made.clock() < powered_at
            return state if is_early else next_state(state, word, before)

        def send_frames_of_another_fin() -> None:
            frame = can.Message(
                arbitration_id=protocol.TPDO[0] + 9, data=bytes(6), is_extended_id=False
            )
            while not host.killed.is_set():
                bus.send(frame)
                made.clock.sleep(0.0002)

        monkeypatch.setattr(emulated_motor, "next_state", power_up_slowly)
        made.clock.spawn(send_frames_of_another_fin, "another fin")
        host.drive.open()
        host.drive.zero()
        assert made.clock() >= powered_at
        host.killed.set()
