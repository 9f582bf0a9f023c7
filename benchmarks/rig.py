"""The rig's loop against emulators in another process, how soon a fault stops the drive, and what
safety costs a tick.

Beside them the physical limits: a tick is 10 ms, a CAN frame of 8 bytes takes 111 to 130 us at 1
Mbit/s. Options by environment: SOFTFIN_RIG_SECONDS of the loop (60), SOFTFIN_RIG_STOPS of each kind
of fault (25).
"""

import contextlib
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import yaml
from tests.rig.simple_fin import SimpleFin

from benchmarks.measure import entry
from softfin.control.controller import LoadedController, Measured
from softfin.control.store import load_controller
from softfin.core.errors import SafetyStop
from softfin.emulation.rig import EmulatedRig
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig
from softfin.rig.devices.epos2 import protocol
from softfin.rig.loop import run_controller
from softfin.rig.machine import Sample, Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard, SafetyConfig, check_target
from softfin.rig.session import Session

SECONDS = int(os.environ.get("SOFTFIN_RIG_SECONDS", "60"))
STOPS = int(os.environ.get("SOFTFIN_RIG_STOPS", "25"))

TICK_MS = 10.0
FRAME_MS = 0.13
"""Of 8 bytes at 1 Mbit/s with the most stuffing."""

RECEIVE_PDO_1 = 0x200
HEARTBEAT_OF_NODE_1 = 0x701
STEPS = 5000
WARM = 500

SAFETY = {
    "current_peak_a": 20.0,
    "current_sustained_a": 10.0,
    "acceleration_rad_s2": 1e5,
    "training_margin": None,
}


def main() -> list[dict[str, Any]]:
    with tempfile.TemporaryDirectory(dir=os.environ.get("SOFTFIN_BENCHMARK_DISK")) as folder:
        controller = _controller(Path(folder))
        rows = _loop(Path(folder), controller) + _step(controller)
    return rows + _stops()


def _controller(folder: Path) -> LoadedController:
    """An LSTM of 64 with random weights; speed does not depend on them."""
    from benchmarks.controller_step import write_policies
    from softfin.learning.configuration import SINGLE

    write_policies(folder / "controller", SINGLE, 64)
    return load_controller(folder / "controller")


def _loop(folder: Path, controller: LoadedController) -> list[dict[str, Any]]:
    """100 Hz with recording and a controller; the emulated devices are another process, over
    sockets."""
    with emulators(folder / "rig.yaml") as config:
        rig = Rig(config)
        with (
            Session(rig, Guard(config.safety, rig.limits)) as session,
            session.recording(folder / "loop.mcap"),
        ):
            session.activate()
            # The first actions fill caches; the loop is judged as it goes on.
            list(run_controller(session, controller, lambda at: (1.0, 0.0), 3))
            before = rig.counters()
            skipped = session.pace.skipped
            late: list[float] = []
            wait = session.pace.wait
            session.pace.wait = lambda: late.append(wait()) or late[-1]  # type: ignore[method-assign, func-returns-value]
            cpu = time.process_time()
            start = time.monotonic()
            list(run_controller(session, controller, lambda at: (1.0, 0.0), 3 * SECONDS))
            share = (time.process_time() - cpu) / (time.monotonic() - start)
            counted = {name: count - before.get(name, 0) for name, count in rig.counters().items()}
            session.deactivate()
    lost = (
        counted["sensor_lost"]
        + counted.get("drive_syncs_without_all_answers", 0)
        + session.pace.skipped
        - skipped
    )
    return [
        entry(
            "100 Hz loop, lateness of a tick, p99",
            1e3 * _quantile(late, 0.99),
            "ms",
            2,
            at_least=False,
            p50_ms=1e3 * statistics.median(late),
            worst_ms=1e3 * max(late),
            tick_ms=TICK_MS,
            seconds=SECONDS,
        ),
        entry(
            "100 Hz loop, readings lost",
            lost,
            "of both devices",
            0,
            at_least=False,
            ticks=len(late),
            force_records=counted["sensor_records"],
        ),
        entry("100 Hz loop with recording, one core's share", 100 * share, "%", 30, at_least=False),
    ]


@contextlib.contextmanager
def emulators(file: Path) -> Iterator[RigConfig]:
    """`softfin rig emulate --real-time` until the end; a rig that waits longer for it than a person
    should."""
    process = subprocess.Popen(
        [sys.executable, "-m", "softfin.cli", "rig", "emulate", "--real-time", "--rig", str(file)],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        for line in process.stdout:
            if "RDT port" in line:
                break
        values = yaml.safe_load(file.read_text())
        wide = {"overrun_s": 1.0, "stale_s": 1.0, "force_stale_s": 1.0, "watchdog_s": 2.0}
        values["safety"] = SAFETY | wide
        values["drive"] |= {"zero_needed": False, "heartbeat_s": 1.0}
        yield RigConfig.build(values, str(file))
    finally:
        process.terminate()
        process.wait()


FAULTS: dict[str, Callable[[EmulatedRig], None]] = {
    "emergency frame": lambda rig: rig.drive.fault(0x2310),
    "sensor's status": lambda rig: setattr(rig.sensor, "status", 0x88000000),
    "force": lambda rig: setattr(rig.fin, "pulled", True),
    "heartbeat": lambda rig: rig.drive.drop_heartbeat(),
}

HEARTBEAT_S = 0.2


class PulledFin(SimpleFin):
    """One at which somebody may pull."""

    pulled = False

    def now(self) -> Any:
        motion = super().now()
        return motion._replace(wrench=(60.0, *motion.wrench[1:])) if self.pulled else motion


def _stops() -> list[dict[str, Any]]:
    """From the moment of a fault to the quick-stop frame, as another listener on the bus gets
    it."""
    rows = []
    together = []
    for name, provoke in FAULTS.items():
        times = [1e3 * _stop(name, provoke) for _ in range(STOPS)]
        filtered = {"filter_ms": 1e3 * _filter_delay()} if name == "force" else {}
        rows.append(
            entry(
                f"stop after {name}, p99",
                _quantile(times, 0.99),
                "ms",
                20,
                at_least=False,
                count=len(times),
                p50_ms=statistics.median(times),
                worst_ms=max(times),
                tick_ms=TICK_MS,
                frame_ms=FRAME_MS,
                **filtered,
            )
        )
        together += times
    return [
        entry(
            "stop after any fault, p99",
            _quantile(together, 0.99),
            "ms",
            20,
            at_least=False,
            count=len(together),
            p50_ms=statistics.median(together),
            worst_ms=max(together),
        ),
        *rows,
    ]


def _stop(name: str, provoke: Callable[[EmulatedRig], None]) -> float:
    with EmulatedRig(fin=PulledFin(), clock=COMPUTER) as emulated:
        values = emulated.values(
            bus={"interface": "virtual", "channel": emulated.channel}, safety=SAFETY
        )
        values["drive"] |= {"zero_needed": False, "heartbeat_s": HEARTBEAT_S}
        rig = Rig(RigConfig.build(values, "emulated rig"))
        began: list[float] = []

        def fault() -> None:
            began.append(time.monotonic())
            provoke(emulated)

        # At any moment of a tick, from a thread that the loop knows nothing of.
        timer = threading.Timer(0.1 + 0.05 * (time.monotonic() % 1), fault)
        with _QuickStop(values["bus"]["channel"]) as listener:
            try:
                with Session(rig, Guard(rig.config.safety, rig.limits)) as session:
                    session.activate()
                    session.command(Target(1.5, 1.0))
                    timer.start()
                    for _ in range(200):
                        session.tick()
            except SafetyStop:
                timer.join()
            else:
                raise SystemExit(f"{name}: nothing stopped for 2 s")
            # That a heartbeat is missing is known only when the time after the last one is over.
            known = listener.beat + HEARTBEAT_S if name == "heartbeat" else began[0]
            return next(at for at in listener.times if at >= began[0]) - known


class _QuickStop:
    """An independent listener: the times of all quick-stop words."""

    def __init__(self, channel: str) -> None:
        self.times: list[float] = []
        self.beat = 0.0
        """The last of the drive."""
        self._bus = can.Bus(interface="virtual", channel=channel)
        self._notifier = can.Notifier(self._bus, [self._take])

    def _take(self, message: can.Message) -> None:
        if message.arbitration_id == HEARTBEAT_OF_NODE_1:
            self.beat = time.monotonic()
        if message.arbitration_id & 0x780 == RECEIVE_PDO_1:
            (word,) = struct.unpack_from("<H", message.data)
            if word == protocol.QUICK_STOP:
                self.times.append(time.monotonic())

    def __enter__(self) -> "_QuickStop":
        return self

    def __exit__(self, *_: object) -> None:
        self._notifier.stop()
        self._bus.shutdown()


def _filter_delay() -> float:
    with EmulatedRig(fin=SimpleFin(), clock=COMPUTER) as emulated:
        rig = Rig(RigConfig.build(emulated.values(), "emulated rig"))
        rig.sensor.open()
        delay = rig.sensor.stream.delay_s
        rig.sensor.close()
        return delay


def _step(controller: LoadedController) -> list[dict[str, Any]]:
    """All that safety looks at in a tick, and one action with its own check; one thread."""
    guard = Guard(SafetyConfig(current_peak_a=6.0, current_sustained_a=3.0), controller.limits)
    state = controller.init()
    ticks = []
    actions = []
    for step in range(WARM + STEPS):
        now = step / 100
        sample = Sample(now, 0.3, 1.0, 0.5, 0.01, now - 0.02, (1.0, 0.5, 0.1, 0.01, 0.02, 0.03), ())
        start = time.perf_counter()
        assert guard.check(sample, now) is None
        middle = time.perf_counter()
        state, command = controller.act(state, Measured(0.3, (1.0, 0.5)), (1.0, 0.0))
        assert (
            check_target(Target(float(command.angle), float(command.velocity)), guard.limits)
            is None
        )
        end = time.perf_counter()
        if step >= WARM:
            ticks.append(1e3 * (middle - start))
            actions.append(1e3 * (end - start))
    return [
        entry(
            "safety's look at a tick, p99",
            _quantile(ticks, 0.99),
            "ms",
            0.1,
            at_least=False,
            p50_ms=statistics.median(ticks),
            worst_ms=max(ticks),
            tick_ms=TICK_MS,
        ),
        entry(
            "controller step with safety, LSTM 64, p99",
            _quantile(actions, 0.99),
            "ms",
            0.2,
            at_least=False,
            p50_ms=statistics.median(actions),
            worst_ms=max(actions),
            tick_ms=TICK_MS,
        ),
    ]


def _quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]
