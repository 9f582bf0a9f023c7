"""Whatever goes wrong while the fin moves ends in a safe stop, or is counted and goes on; nothing
moves afterwards.

In simulated time; `SOFTFIN_LONG=1` injects faults in real time, too, for twenty minutes, or for as
many as `SOFTFIN_SOAK_MINUTES` says.
"""

import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import can
import pytest
import yaml

from softfin.core.errors import SafetyStop
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2.drive import USUAL
from softfin.emulation.rig import EmulatedRig
from softfin.rig.bus import BusConfig
from softfin.rig.computer import COMPUTER
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.loop import run_controller
from softfin.rig.machine import Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from tests.patience import HANG_S
from tests.rig.bags import events_of
from tests.rig.deaths import DRIVE, Station, cut, swim_by_values
from tests.rig.devices.axia80.faulty_network import FaultyNetwork
from tests.rig.devices.epos2.bench import block, ignore_targets
from tests.rig.machines import Wagging
from tests.rig.rigs import SAFETY, config_of
from tests.rig.simple_fin import SimpleFin

LONG = os.environ.get("SOFTFIN_LONG") == "1"
LONG_S = 60 * float(os.environ.get("SOFTFIN_SOAK_MINUTES", "20"))

WIDE = {
    "current_peak_a": 20.0,
    "current_sustained_a": 10.0,
    "overrun_s": 0.8,
    "stale_s": 0.8,
    "force_stale_s": 0.8,
    "watchdog_s": 1.8,
    "acceleration_rad_s2": 1e5,
    "velocity_rad_s": 100.0,
    "following_s": 0.2,
}
"""In real time, so that a busy machine alone does not stop the fin: only what is injected does."""

PATIENT = {"heartbeat_s": 1.0, "sync_s": 0.02}
"""Likewise, of the drive."""

BUSY = "0x8130|silent for|ms late|heartbeat has been missing|no new angle for|no new force for"
"""What a machine that is too busy for a while is stopped by, before any other fault is seen."""

SESSION_ENDS_S = 20.0
"""Longest simulated time from a fault to the end of its session [s]."""

DRIVE_STOPS_S = 5.0
"""Longest simulated time until the motor is disabled after that [s]."""

Inject = Callable[["Scene"], None]


class Scene:
    """An emulated rig, the session on it and its bag; what is injected finds all of it here."""

    def __init__(self, emulated: EmulatedRig, rig: Rig, session: Session, bag: Path) -> None:
        self.emulated = emulated
        self.rig = rig
        self.session = session
        self.bag = bag
        self.clock = emulated.clock
        self.patches = pytest.MonkeyPatch()
        self.beside: threading.Thread | None = None
        """What goes on beside the session, which ends by itself."""


@contextmanager
def scene(bag: Path, real_time: bool = False, **drive: Any) -> Iterator[Scene]:
    clock = COMPUTER if real_time else SimulatedClock()
    with EmulatedRig(fin=SimpleFin(clock), clock=clock) as emulated:
        values = emulated.values(safety=WIDE if real_time else SAFETY)
        patient = PATIENT if real_time else {}
        values["drive"] |= {**patient, "zero_needed": False, **drive}
        rig = Rig(
            config_of(emulated, **{name: values[name] for name in ("drive", "safety")}), clock
        )
        made = Scene(emulated, rig, Session(rig, Guard(rig.config.safety, rig.limits)), bag)
        try:
            yield made
        finally:
            made.patches.undo()


def bus_lost(at: Scene) -> None:
    """The host's adapter takes no frames any more."""

    def refuse(message: can.Message, timeout: float | None = None) -> None:
        raise can.CanOperationError("Transmit buffer full")

    at.patches.setattr(at.rig.drive.connection._bus, "send", refuse)


def network(**fault: Any) -> Inject:
    return lambda at: FaultyNetwork.between(at.emulated.sensor).disturb(**fault)


def error_frame(classes: int, controller: int = 0) -> Inject:
    """The host's adapter reports an error of the bus."""
    return lambda at: at.emulated.drive.send_error_frame(classes, controller)


def another_fin_is_cut_off(at: Scene) -> None:
    """A second fin starts on the same bus, swims, and loses its cable."""
    at.beside = at.clock.spawn(lambda: swim_and_be_cut_off(at), "another fin")


def swim_and_be_cut_off(at: Scene) -> None:
    bus = BusConfig(interface="virtual", channel=at.emulated.channel)
    patience = PATIENT if at.clock is COMPUTER else {}
    with closing(
        Station(bus, bus.model_dump(), {**DRIVE, **patience, "node": 2}, USUAL, at.clock)
    ) as station:
        host = at.clock.spawn(lambda: swim_by_values(station.values, 0, at.clock), "its host")
        end = at.clock() + limit_of(at, SESSION_ENDS_S)
        while station.drive.state is not State.OPERATION_ENABLED:
            assert at.clock() < end, "the other fin does not swim"
            at.clock.sleep(0.01)
        at.clock.sleep(0.3)
        cut([station])
        host.join(limit_of(at, SESSION_ENDS_S))
        assert not host.is_alive(), "the host of the other fin hangs"
        assert station.is_at_rest


def bus_off(at: Scene) -> None:
    at.emulated.drive.go_silent()
    at.emulated.drive.fault(0x81FD)


def disk_full(at: Scene) -> None:
    import softfin.storage.bag.writer as writer

    def sync(file: int) -> None:
        raise OSError(28, "No space left on device")

    at.patches.setattr(writer.os, "fsync", sync)


def clock_jump(at: Scene) -> None:
    ahead = time.time() + 86_400
    at.patches.setattr(time, "time", lambda: ahead)


STOPS: dict[str, tuple[Inject, str]] = {
    "bus off": (bus_off, "no new angle|heartbeat|did not acknowledge a target"),
    "adapter bus-off": (error_frame(0x040), "adapter is bus-off"),
    "adapter error passive": (error_frame(0x004, 0x20), "adapter is error passive"),
    "bus takes no frames": (bus_lost, "does not accept frames|angle"),
    "cable of the drive cut": (
        lambda at: at.emulated.drive.go_silent(),
        "no new angle|heartbeat|did not acknowledge",
    ),
    "heartbeat lost": (
        lambda at: at.emulated.drive.drop_heartbeat(),
        "heartbeat has been missing",
    ),
    "emergency frame": (lambda at: at.emulated.drive.fault(0x8611), "0x8611, following error"),
    "over-current": (lambda at: at.emulated.drive.fault(0x2310), "0x2310, over-current"),
    "limit of the drive holds it back": (
        lambda at: setattr(at.emulated.drive, "at_limit", True),
        "its internal limits",
    ),
    "drive starts anew": (lambda at: at.emulated.drive.reboot(), "restarted|state"),
    "blocked fin": (lambda at: block(at.emulated.fin), "following|behind"),
    "over-range": (
        lambda at: setattr(at.emulated.sensor, "status", 0xC0000000),
        "force sensor 127.0.0.1",
    ),
    "broken gage": (
        lambda at: setattr(at.emulated.sensor, "status", 0x88000000),
        "force sensor 127.0.0.1",
    ),
    "sensor silent": (lambda at: at.emulated.sensor.silence(), "no usable record|no new force"),
    "sensor starts anew": (
        lambda at: at.emulated.sensor.reboot(0.1),
        "no usable record|no new force|restarted",
    ),
    "sensor's values stand still": (
        lambda at: setattr(at.emulated.sensor, "are_values_frozen", True),
        "values are frozen",
    ),
    "all packets lost": (network(drop=1.0), "no usable record|no new force"),
    "disk full": (disk_full, "No space left on device"),
}
"""Each ends in a safe stop whose reason matches."""

GOES_ON: dict[str, tuple[Inject, tuple[str, ...]]] = {
    "packets lost": (network(drop=0.1), ("sensor_lost",)),
    "packets late": (network(late=30), ()),
    "packets doubled": (network(duplicate=0.2), ("sensor_late",)),
    "packets reordered": (network(reorder=0.2), ("sensor_late",)),
    "wall clock jumps": (clock_jump, ()),
    "bus loses arbitrations": (error_frame(0x002), ("drive_lost_arbitrations",)),
    "another fin is cut off": (another_fin_is_cut_off, ()),
    "targets not taken": (
        lambda at: ignore_targets(at.emulated.drive, 1),
        ("drive_targets_repeated",),
    ),
}
"""Each is counted, and the fin goes on."""


def at_a_moment(inject: Callable[[], None], numbers: random.Random) -> Callable[[Any, Any], None]:
    """An observer that does it some ticks after the fin has begun to move."""
    moment = numbers.randint(3, 30)
    ticks = 0

    def observe(sample: Any, target: Target | None) -> None:
        nonlocal ticks
        if target is not None and abs(target.angle) > 0.1:
            ticks += 1
            if ticks == moment:
                inject()

    return observe


def limit_of(at: Scene, simulated_s: float) -> float:
    """A limit in simulated time; in real time a busy machine may take longer."""
    return HANG_S if at.clock is COMPUTER else simulated_s


def stopped(at: Scene, inject: Inject, words: str, numbers: random.Random) -> None:
    """Move, inject, and see that all ends as it must."""
    ended: list[BaseException | None] = []

    def run() -> None:
        try:
            with at.session as session, session.recording(at.bag):
                session.observers = [at_a_moment(lambda: inject(at), numbers)]
                session.activate()
                list(run_controller(session, Wagging(), lambda _: (0.0, 0.0)))
            ended.append(None)
        except BaseException as error:
            ended.append(error)

    at.clock.spawn(run, "session").join(limit_of(at, SESSION_ENDS_S))
    assert ended, "the session hangs"
    error = ended[0]
    assert isinstance(error, SafetyStop), repr(error)
    assert "\n" not in str(error)
    assert at.session.trip is not None
    assert re.search(f"{words}|{BUSY}" if at.clock is COMPUTER else words, str(error)), error
    still(at)
    at.patches.undo()
    told = events_of(at.bag) if at.session.trip.cause != "recording" else []
    assert not told or any(
        event.startswith(f"stopped: {at.session.trip.cause}: ") for event in told[-2:]
    ), told


def still(at: Scene) -> None:
    """The motor is disabled, by the host's word or by the drive's own watch, and the fin does not
    move."""
    deadline = at.clock() + limit_of(at, DRIVE_STOPS_S)
    off = {
        State.SWITCH_ON_DISABLED,
        State.READY,
        State.SWITCHED_ON,
        State.FAULT,
        State.START,
        State.NOT_READY,
    }
    while at.emulated.drive.state not in off and at.clock() < deadline:
        at.clock.sleep(0.01)
    assert at.emulated.drive.state in off, at.emulated.drive.state
    where = at.emulated.fin.now().angle
    at.clock.sleep(0.1)
    assert at.emulated.fin.now().angle == where


def went_on(
    at: Scene, disturbances: list[tuple[Inject, tuple[str, ...]]], numbers: random.Random
) -> None:
    with at.session as session, session.recording(at.bag):
        session.activate()
        for inject, counters in disturbances:
            session.observers = [at_a_moment(lambda inject=inject: inject(at), numbers)]
            before = session.machine.counters()
            list(run_controller(session, Wagging(), lambda _: (0.0, 0.0), actions=2))
            while at.beside is not None and at.beside.is_alive():
                list(run_controller(session, Wagging(), lambda _: (0.0, 0.0), actions=1))
            after = session.machine.counters()
            for name in counters:
                assert after[name] > before.get(name, 0), (name, after)
            quiet(at)
        session.deactivate()
    still(at)
    assert events_of(at.bag)[-1] == "inactive"


def quiet(at: Scene) -> None:
    """No disturbance any more."""
    at.patches.undo()
    FaultyNetwork.between(at.emulated.sensor)


@pytest.mark.parametrize("name", STOPS)
def test_a_fault_ends_in_a_safe_stop(name, tmp_path):
    inject, words = STOPS[name]
    with scene(tmp_path / "run.mcap") as at:
        stopped(at, inject, words, random.Random(name))


def test_disturbances_are_counted_and_the_fin_goes_on(tmp_path):
    with scene(tmp_path / "run.mcap") as at:
        went_on(at, list(GOES_ON.values()), random.Random(1))


@pytest.mark.real_time
def test_a_paused_process_finds_its_fin_stopped_when_it_goes_on(tmp_path):
    with scene(tmp_path / "unused.mcap", real_time=True) as at:
        pausing(at, tmp_path, random.Random(2))


def pausing(at: Scene, folder: Path, numbers: random.Random) -> None:
    """The session in another process, which is stopped as by Ctrl-Z, and goes on."""
    values = at.emulated.values()
    values["drive"] |= {**PATIENT, "zero_needed": False}
    (folder / "rig.yaml").write_text(yaml.safe_dump(values))
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "tests.rig.soak_process",
            str(folder / "rig.yaml"),
            str(folder / "run.mcap"),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=Path(__file__).parents[2],
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "moves\n", process.communicate(timeout=HANG_S)
        time.sleep(numbers.uniform(0.1, 0.6))
        process.send_signal(signal.SIGSTOP)
        # Nobody beats for it any more: the drive stops by itself.
        still(at)
        where = at.emulated.fin.now().angle
        process.send_signal(signal.SIGCONT)
        _, told = process.communicate(timeout=HANG_S)
        assert process.returncode == 3, told
        assert told.count("\n") == 1, told
        assert "stopped, motor disabled: " in told
        assert at.emulated.fin.now().angle == where
        assert any("stopped: " in event for event in events_of(folder / "run.mcap")[-2:])
    finally:
        process.kill()
        process.communicate()


@pytest.mark.real_time
@pytest.mark.slow
@pytest.mark.skipif(not LONG, reason="takes twenty minutes; SOFTFIN_LONG=1 runs it")
def test_soak(tmp_path):
    numbers = random.Random(int(os.environ.get("SOFTFIN_SOAK_SEED", "0")))
    end = time.monotonic() + LONG_S
    rounds = 0
    while time.monotonic() < end:
        name = numbers.choice([*STOPS, *GOES_ON, "pause"])
        folder = tmp_path / str(rounds)
        folder.mkdir()
        rounds += 1
        with scene(folder / "run.mcap", True) as at:
            try:
                if name == "pause":
                    pausing(at, folder, numbers)
                elif name in STOPS:
                    stopped(at, *STOPS[name], numbers)
                else:
                    went_on(at, [GOES_ON[name]], numbers)
            except AssertionError as error:
                raise AssertionError(f"round {rounds}, {name}: {error}") from error
    assert rounds > 0
