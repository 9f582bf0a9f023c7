"""The emulated drive at somebody else's client: canopen's own CiA 402 node on python-can's virtual
bus."""

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import can
import canopen
from canopen.profiles.p402 import BaseNode402

from softfin.emulation.epos2.drive import EmulatedDrive
from softfin.emulation.epos2.objects import dictionary, values
from tests.patience import HANG_S, wait_until
from tests.rig.devices.epos2.bench import NODE, bus_config, drive_config
from tests.rig.machines import Hours
from tests.rig.simple_fin import SimpleFin

PRE_OPERATIONAL = 0x80
OPERATIONAL = 0x01
STOPPED = 0x02
RESET_NODE = 0x81


class CanopenBench:
    """A remote node of canopen's, its network, the emulated drive and its fin; all that is on the
    bus is kept."""

    def __init__(self, network: Any, drive: EmulatedDrive, fin: SimpleFin, clock: Hours) -> None:
        self.network = network
        self.drive = drive
        self.fin = fin
        self.clock = clock
        self.node = network.add_node(BaseNode402(NODE, dictionary(values(drive_config()))))
        # A busy machine is no fault of the drive.
        self.node.sdo.RESPONSE_TIMEOUT = HANG_S
        self.frames: list[tuple[int, bytes]] = []
        network.notifier.add_listener(
            lambda message: self.frames.append((message.arbitration_id, bytes(message.data)))
        )

    def read(self, index: int, sub: int = 0) -> int:
        """An object as an unsigned number; all frames that were sent before have been taken when it
        is there."""
        return int.from_bytes(self.node.sdo.upload(index, sub), "little")

    def write(self, index: int, sub: int, value: int, size: int) -> None:
        self.node.sdo.download(index, sub, value.to_bytes(size, "little"))

    def send(self, cob_id: int, data: bytes = b"", **options: bool) -> None:
        message = can.Message(
            arbitration_id=cob_id, data=data, **{"is_extended_id": False, **options}
        )
        self.network.bus.send(message)

    def nmt(self, command: int) -> None:
        self.send(0x000, bytes([command, NODE]))

    def count(self, cob_id: int) -> int:
        return [frame[0] for frame in self.frames].count(cob_id)

    def until(self, true: Callable[[], bool]) -> None:
        wait_until(true)

    def until_state(self, word: int) -> None:
        self.until(lambda: self.read(0x6041) & 0x417F == word)

    def enable(self) -> None:
        self.until_state(0x140)
        for word, state in ((0x06, 0x121), (0x07, 0x123), (0x0F, 0x137)):
            self.write(0x6040, 0, word, 2)
            self.until_state(state)

    def map(self, number: int, transmission: int, *entries: int) -> None:
        """A PDO, which is on then; the node must not be operational."""
        cob_id = {0x1400: 0x200, 0x1800: 0x180}[number & 0xFF00] + 0x100 * (number & 0xFF) + NODE
        self.write(number, 1, cob_id | 1 << 31, 4)
        self.write(number, 2, transmission, 1)
        self.write(number + 0x200, 0, 0, 1)
        for place, entry in enumerate(entries, 1):
            self.write(number + 0x200, place, entry, 4)
        self.write(number + 0x200, 0, len(entries), 1)
        self.write(number, 1, cob_id, 4)


@contextmanager
def canopen_bench() -> Iterator[CanopenBench]:
    """Fin and drive on a clock that stands until the test moves it."""
    bus = bus_config()
    clock = Hours()
    fin = SimpleFin(clock)
    network: Any = canopen.Network()
    network.NOTIFIER_CYCLE = 0.02
    with closing(EmulatedDrive(bus, drive_config(), fin, clock)) as drive:
        network.connect(interface=bus.interface, channel=bus.channel)
        try:
            yield CanopenBench(network, drive, fin, clock)
        finally:
            network.disconnect()
