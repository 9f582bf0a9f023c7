"""Deaths of hosts and cuts of cables, of one fin or of several on one bus: how soon does each fin
stand by itself?

Every fin has an emulated drive and sensor, and a host of its own: a rig and a session that strokes
from end to end. To a drive, a host that is killed and one that is stopped look the same: nothing
comes any more. `Fleet` has the emulators and watches the fins, in simulated or in real time; the
hosts are threads here, and processes in benchmarks/rig_deaths.
"""

import contextlib
import random
import sys
import uuid
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from softfin.core.choices import LOOPBACK
from softfin.core.clock import Clock
from softfin.core.errors import SoftfinError
from softfin.emulation.axia80 import EmulatedAxia80
from softfin.emulation.bus import SocketcandServer
from softfin.emulation.clock import SimulatedClock
from softfin.emulation.epos2.drive import (
    MOTION_STEP_S,
    USUAL,
    DriveTraits,
    EmulatedDrive,
)
from softfin.rig.bus import BusConfig
from softfin.rig.computer import COMPUTER
from softfin.rig.config import RigConfig
from softfin.rig.devices.epos2.config import Epos2Config
from softfin.rig.devices.epos2.protocol import UNPOWERED, State
from softfin.rig.loop import run_controller
from softfin.rig.machine import Target
from softfin.rig.rig import Rig
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from tests.rig.braking_fin import BrakingFin
from tests.rig.machines import Wagging
from tests.rig.rigs import SAFETY, WIDE

WATCH_STEP_S = 0.001
"""Time between two looks at the fins."""

SIMULATED_MARGIN_S = 2 * MOTION_STEP_S + WATCH_STEP_S
"""The drive looks at its host's silence once a step and at its own standstill once a step; the
watcher comes last."""

AFTERWARDS_S = 0.2
"""Time after the limit for which a fin is watched on: it must not move again."""

LONGEST_START_S = 60.0
"""Time within which all fins must swim; a real host takes seconds on a busy computer."""

MOMENTS_S = 1.0
"""A death comes at a random moment within so long, which begins when the first controlword powers
the motor up."""

STROKE_RAD = 1.5
SLOWEST_STROKE_RAD_S = 1.0
"""At this velocity, too, a stroke lasts longer than an action: the fin is never at rest."""

RECORDS_HZ = 200.0
"""Records of each sensor; few, because the deaths are the drives' business and four sensors take
much of a computer."""

PATIENT_SYNC_S = 0.1
"""In real time Python serves the bus: a drive may take tenths of a second to acknowledge a
target."""

DRIVE = {
    "encoder_lines": 500,
    "gear_ratio": 111.0,
    "acceleration_rad_s2": 80.0,
    "quick_stop_rad_s2": 60.0,
    "following_error_rad": 0.5,
    "zero_needed": False,
}


class Station:
    """The emulated side of one fin."""

    def __init__(
        self,
        bus: BusConfig,
        host_bus: dict[str, Any],
        drive: dict[str, Any],
        traits: DriveTraits,
        clock: Clock,
    ) -> None:
        config = Epos2Config.build(drive, "drive")
        self.name = f"fin {config.node}"
        self.fin = BrakingFin(config.quick_stop_rad_s2, clock)
        self.drive = EmulatedDrive(bus, config, self.fin, clock, traits)
        self.sensor = EmulatedAxia80(self.fin, rate_hz=RECORDS_HZ, clock=clock)
        is_simulated = isinstance(clock, SimulatedClock)
        limits = SAFETY if is_simulated else SAFETY | WIDE
        ports = {"rdt_port": self.sensor.rdt_port, "http_port": self.sensor.http_port}
        self.values: dict[str, Any] = {
            "fin": self.name,
            "bus": host_bus,
            "drive": drive if is_simulated else drive | {"sync_s": PATIENT_SYNC_S},
            "sensor": {"address": LOOPBACK, "frame": "x,y", "rate_hz": RECORDS_HZ, **ports},
            "safety": limits,
        }
        """Contents of the rig's file of its host."""

    @property
    def is_at_rest(self) -> bool:
        """Whether the motor has no power and the fin does not move."""
        return self.drive.state in UNPOWERED and self.fin.now().velocity == 0.0

    def close(self) -> None:
        self.sensor.close()
        self.drive.close()


class Outcome(NamedTuple):
    """What the watcher of a fleet has seen."""

    rest_s: float
    """Time until the last of the fins that were to stand stood without power, for good; infinite if
    one did not."""
    way_rad: float
    """Longest way of these fins."""
    disturbed: tuple[str, ...]
    """Fins that did what they must not, each with what it was: most often one that did not swim
    on."""
    lag_s: float
    """Time for which frames of a dead host still came in, because the bus lags behind; one of
    copper does not."""
    look_s: float
    """Longest time between two looks: how late the threads of this process run."""

    def then(self, later: "Outcome") -> "Outcome":
        """Return this outcome followed by a later one, in which nothing may move that stood
        before."""
        moved_again = () if later.rest_s == 0.0 else ("a fin that was to stand moved",)
        return Outcome(
            rest_s=self.rest_s,
            way_rad=self.way_rad + later.way_rad,
            disturbed=self.disturbed + later.disturbed + moved_again,
            lag_s=self.lag_s,
            look_s=max(self.look_s, later.look_s),
        )


class Fleet(contextlib.ExitStack):
    """Emulated drives with the nodes 1, 2 .. on one bus, a fin and a sensor each."""

    def __init__(
        self, count: int, heartbeat_s: float, clock: Clock, traits: DriveTraits = USUAL
    ) -> None:
        super().__init__()
        self.clock = clock
        channel = f"fleet-{uuid.uuid4().hex[:8]}"
        bus = BusConfig(interface="virtual", channel=channel)
        host_bus = bus.model_dump()
        if not isinstance(clock, SimulatedClock):
            server = self.enter_context(SocketcandServer(channel))
            options = {"host": LOOPBACK, "port": server.port, "tcp_tune": True}
            host_bus |= {"interface": "socketcand", "options": options}
        self.stations: list[Station] = []
        for node in range(1, count + 1):
            drive = {"node": node, "heartbeat_s": heartbeat_s, **DRIVE}
            station = Station(bus, host_bus, drive, traits, clock)
            self.callback(station.close)
            self.stations.append(station)
        config = Epos2Config.build(drive, "drive")
        self.limit_s = heartbeat_s + config.fastest_rad_s / config.quick_stop_rad_s2
        """Longest time from a death to rest, without a margin: silence until the drive notices, and
        its braking."""

    def await_swimming(self, victim: Station) -> None:
        """Wait until the victim's motor is being powered up and all others swim."""
        others = [station for station in self.stations if station is not victim]

        def swims() -> bool:
            if victim.drive.state in (State.START, State.NOT_READY, State.SWITCH_ON_DISABLED):
                return False
            return all(station.drive.state is State.OPERATION_ENABLED for station in others)

        end = self.clock() + LONGEST_START_S
        while not swims():
            assert self.clock() < end, "the fins do not begin to swim"
            self.clock.sleep(WATCH_STEP_S)

    def watch(self, affected: Sequence[Station], seconds: float) -> Outcome:
        """Watch all fins for a time [s], of which the affected ones are to come to rest."""
        angles = [station.fin.now().angle for station in self.stations]
        ways = [0.0] * len(angles)
        others = [station for station in self.stations if station not in affected]
        began = look = self.clock()
        look_s = lag_s = 0.0
        disturbed: dict[Station, str] = {}
        rest_since = began if all(station.is_at_rest for station in affected) else None
        is_over = False
        while not is_over:
            self.clock.sleep(WATCH_STEP_S)
            now = self.clock()
            look_s = max(look_s, now - look)
            look = now
            for index, station in enumerate(self.stations):
                angle = station.fin.now().angle
                ways[index] += abs(angle - angles[index])
                angles[index] = angle
            for station in affected:
                # The drive's own note of its host's last heartbeat, which it forgets when it misses
                # the next ones.
                lag_s = max(lag_s, (station.drive._host_beat or began) - began)
            if not all(station.is_at_rest for station in affected):
                rest_since = None
            elif rest_since is None:
                rest_since = now
            for station in others:
                state = station.drive.state
                if state is not State.OPERATION_ENABLED:
                    disturbed.setdefault(
                        station, f"{station.name}: {state.name} after {now - began:.3f} s"
                    )
            is_over = now - began >= seconds
        way_by_station = dict(zip(self.stations, ways, strict=True))
        for station in others:
            if way_by_station[station] == 0.0:
                disturbed.setdefault(station, f"{station.name}: did not move")
        return Outcome(
            rest_s=float("inf") if rest_since is None else rest_since - began,
            way_rad=max(way_by_station[station] for station in affected),
            disturbed=tuple(disturbed.values()),
            lag_s=lag_s,
            look_s=look_s,
        )


def swim(session: Session, seed: int) -> None:
    """Stroke from end to end at random velocities until the session is stopped."""
    numbers = random.Random(seed)
    fastest = session.machine.limits.velocity_max

    def stroke(action: int) -> Target:
        angle = STROKE_RAD if action % 2 else -STROKE_RAD
        return Target(angle, numbers.uniform(SLOWEST_STROKE_RAD_S, fastest))

    with session:
        session.activate()
        for _ in run_controller(session, Wagging(stroke), lambda _: (0.0, 0.0)):
            pass


def swim_by_values(values: dict[str, Any], seed: int, clock: Clock = COMPUTER) -> None:
    """Be the host of a fin until its session ends."""
    rig = Rig(RigConfig.build(values, values["fin"]), clock)
    try:
        swim(Session(rig, Guard(rig.config.safety, rig.limits)), seed)
    except SoftfinError as error:
        sys.stderr.write(f"{rig.config.fin}: {error}\n")


class HostClock(SimulatedClock):
    """A simulated clock as the threads of one host have it: while the host is dead, none of its
    waits ends."""

    __slots__ = ("is_dead",)

    def __init__(self, clock: SimulatedClock) -> None:
        # Time, threads, buses and sockets are those of all; whether it is dead is its own.
        self.__dict__ = clock.__dict__
        self.is_dead = False

    def wait_for(self, ready: Callable[[], Any], timeout: float | None = None) -> bool:
        is_ready = super().wait_for(ready, timeout)
        if self.is_dead:
            super().wait_for(lambda: not self.is_dead)
            is_ready = bool(ready())
        return is_ready


class SimulatedHost:
    """The host of one fin, as threads of a simulated clock."""

    def __init__(self, station: Station, clock: SimulatedClock, seed: int) -> None:
        self.clock = HostClock(clock)
        rig = Rig(RigConfig.build(station.values, station.values["fin"]), self.clock)
        self.session = Session(rig, Guard(rig.config.safety, rig.limits))
        self.error: BaseException | None = None
        self._seed = seed
        self._thread = self.clock.spawn(self._run, "host")

    def die(self) -> None:
        self.clock.is_dead = True

    def go_on(self) -> None:
        """Go on as a stopped process does: late, and not knowing it."""
        self.clock.is_dead = False
        self.clock.sleep(0.0)

    def close(self) -> None:
        self.go_on()
        self.session.stop_request.ask("test", "the trial is over")
        self._thread.join()

    def _run(self) -> None:
        try:
            swim(self.session, self._seed)
        except SoftfinError as error:
            self.error = error


class Trial(NamedTuple):
    """One death, which the seed repeats."""

    kind: str
    count: int
    seed: int

    @property
    def numbers(self) -> random.Random:
        """Random numbers of this trial alone."""
        return random.Random(f"{self.kind} {self.count} {self.seed}")

    def problem(self, outcome: Outcome, limit_s: float) -> str | None:
        """Describe what went wrong; None if nothing did."""
        if outcome.rest_s - outcome.lag_s > limit_s:
            return (
                f"{self}: at rest after {outcome.rest_s:.4f} s, at most {limit_s:.4f} s ({outcome})"
            )
        if outcome.disturbed:
            return f"{self}: {', '.join(outcome.disturbed)} ({outcome})"
        return None


HOST_DIES = "host dies"
CABLE_CUT = "cable of a drive cut"
BUS_CUT = "bus of all cut"


def cut(stations: Sequence[Station]) -> None:
    """Cut the cable of drives: nothing goes in or out."""
    for station in stations:
        station.drive.go_silent()


@contextlib.contextmanager
def simulated_hosts(
    fleet: Fleet, clock: SimulatedClock, numbers: random.Random
) -> Iterator[list[SimulatedHost]]:
    """Start a host for each fin; all are stopped at the end."""
    with contextlib.ExitStack() as stack:
        hosts = []
        for station in fleet.stations:
            host = SimulatedHost(station, clock, numbers.randrange(2**32))
            stack.callback(host.close)
            hosts.append(host)
        yield hosts


def run_simulated_trial(
    trial: Trial, heartbeat_s: float = 0.2, traits: DriveTraits = USUAL
) -> tuple[Outcome, float]:
    """Return what was seen and the limit [s]; a host that goes on after its death must not move its
    fin again."""
    clock = SimulatedClock()
    numbers = trial.numbers
    with (
        Fleet(trial.count, heartbeat_s, clock, traits) as fleet,
        simulated_hosts(fleet, clock, numbers) as hosts,
    ):
        place = numbers.randrange(trial.count)
        victim = fleet.stations[place]
        fleet.await_swimming(victim)
        clock.sleep(numbers.uniform(0.0, MOMENTS_S))
        affected = fleet.stations if trial.kind == BUS_CUT else [victim]
        if trial.kind == HOST_DIES:
            hosts[place].die()
        else:
            cut(affected)
        limit_s = fleet.limit_s + SIMULATED_MARGIN_S
        outcome = fleet.watch(affected, limit_s + AFTERWARDS_S)
        if trial.kind == HOST_DIES:
            hosts[place].go_on()
            outcome = outcome.then(fleet.watch(affected, AFTERWARDS_S))
        return outcome, limit_s
