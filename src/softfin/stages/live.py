"""The stages on a fin that moves by itself: logs recorded and controllers judged in real time, one after the other.

Beside the output folder NAME stands ``NAME-bags`` with a ROS 2 bag of everything, written while it happens and never
removed, and with the logs that are finished, from which an interrupted collection goes on.
"""

import json
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from softfin.control.controller import LoadedController
from softfin.control.disturbance_observer import DisturbanceObserver
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError
from softfin.core.progress import Progress
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits, Log, Reading
from softfin.core.randomness import key_of
from softfin.data.collect import CollectConfig
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.evaluation.experiment import ExperimentRecording
from softfin.rig.bench import Bench, check_fits
from softfin.rig.logged import GAP_S, log_of
from softfin.rig.loop import Acting, hold, seconds_to_actions
from softfin.rig.machine import Sample, Target
from softfin.rig.recording import recording
from softfin.rig.safety import Guard
from softfin.rig.session import Session
from softfin.rig.stop import StopRequest, stopped_by_signals
from softfin.stages import offline as stages
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.log_file import read_log, write_log
from softfin.storage.paths import PARTS

Confirm = Callable[[Bench], None]
"""Asks a person whether the fin may move; raises where the answer is not yes."""

EXTRA_TICKS = 20
"""Read after the last row of a log: its force comes out of the filter a little later."""

HALF_TICK_S = TICK_S / 2
"""Commands are stamped this early, so that the jitter of a tick does not move them to the next row."""

STATE = "collect.json"

SHOWN = 3
"""Of what differs."""


def collect_live(
    bench: Bench,
    out: Path,
    config: CollectConfig,
    confirm: Confirm,
    *,
    resume: bool = False,
    overwrite: bool = False,
    stop: StopRequest | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Record random motions of a real fin as a dataset (paper Sec. III-A), log by log.

    With `resume` those that are finished already are taken over. Raises SafetyStop where the fin had to be stopped;
    what was recorded until then is kept.
    """
    artifacts.check_vacant(out, overwrite or resume)
    bags = bags_of(out)
    facts = {"configuration": config.model_dump(mode="json"), "fin": bench.fin, "rig": bench.described}
    # Where the devices are reached may change from one day to the next.
    same = facts | {"rig": {name: part for name, part in bench.described.items() if name not in ("bus", "sensor")}}
    _check_claim(bags, same, resume)
    if resume and not overwrite and artifacts.is_kind(out, "dataset"):
        # The recordings beside it are those of this collection, and it is written when they are complete.
        return Dataset.open(out)
    artifacts.check_vacant(out, overwrite)
    names = [f"{part}-{i:0{PARTS[part]}d}" for part, count in _counts(config).items() for i in range(count)]
    missing = [name for name in names if not (bags / f"{name}.parquet").exists()]
    counters: dict[str, int] = {}
    if missing:
        request = stop or StopRequest()
        guard = Guard(bench.safety, bench.machine.limits)
        with Session(bench.machine, guard, stop=request) as session:
            _may_move(session, confirm, bench)
            artifacts.write_file(bags / STATE, artifacts.dump_json(same))
            for index, name in enumerate(missing):
                told = _Told(progress, name, index, len(missing), config.rows, bench.settle_s)
                with recording(session, bags / f"{name}.mcap"):
                    log = _record(session, bench, _commands(config, name, bench.machine.limits), told)
                write_log(bags / f"{name}.parquet", log)
            counters = bench.machine.counters() | {"skipped_ticks": session.pace.skipped}
            lateness = session.pace.described()
        facts |= {"counters": counters, "clock": lateness}
    described = {
        "plant": bench.machine.name,
        "plant_identity": bench.machine.name,
        "commands": {"excitation": "random"},
        "bags": bags.name,
        "provenance": artifacts.provenance(seed=config.seed),
        **facts,
    }
    train, test = ([bags / f"{name}.parquet" for name in names if name.startswith(part)] for part in PARTS)
    return write_dataset(out, map(read_log, train), map(read_log, test), described, overwrite)


def evaluate_live(
    controller: Path,
    bench: Bench,
    out: Path,
    config: EvaluateConfig,
    confirm: Confirm,
    *,
    overwrite: bool = False,
    stop: StopRequest | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Judge a controller on a real fin (paper Sec. IV-B, Table II), as `softfin.evaluate` does on a plant."""
    artifacts.check_vacant(out, overwrite)
    loaded = controller_for(controller, bench)
    acting: Acting = loaded if config.trim is None else DisturbanceObserver(loaded, config.trim)
    request = stop or StopRequest()
    guard = Guard(bench.safety, bench.machine.limits, loaded.artifact.training_range)
    bag = bags_of(out) / f"session-{datetime.now().astimezone():%Y%m%d-%H%M%S}.mcap"
    with Session(bench.machine, guard, stop=request) as session:
        _may_move(session, confirm, bench)
        with recording(session, bag):
            fin = LiveFin(session, acting, bench, progress)
            return stages.evaluate(controller, fin, out, config, overwrite=overwrite)


class LiveFin:
    """A real fin and the controller on it, as the evaluation's `RealTime`."""

    def __init__(self, session: Session, controller: Acting, bench: Bench, progress: Progress | None = None) -> None:
        self.limits = Limits(*bench.machine.limits)
        self._session, self._controller, self._bench, self._progress = session, controller, bench, progress

    def __str__(self) -> str:
        return self._bench.machine.name

    def experiments(
        self, references: Float[np.ndarray, "references *ticks 2"], seconds: int, repetitions: int
    ) -> ExperimentRecording:
        """Every reference so many times, one after the other, each from rest."""
        self._session.activate()
        runs = []
        for index, reference in enumerate(references):
            asked = np.broadcast_to(reference, (seconds * RATE_HZ, 2))
            for repetition in range(repetitions):
                done = (index * repetitions + repetition) / (len(references) * repetitions)
                self._tell(done, f"reference {index + 1} of {len(references)}, repetition {repetition + 1}")
                runs.append(self._one(asked, seconds))
        self._session.deactivate()
        self._tell(1.0, "")
        shape = (len(references), repetitions)
        command, reading = jax.tree.map(lambda *parts: np.stack(parts).reshape(*shape, *parts[0].shape), *runs)
        return ExperimentRecording(references, command, reading)

    def _one(self, asked: Float[np.ndarray, "ticks 2"], seconds: int) -> tuple[Command, Reading]:
        session = self._session
        session.rest(self._bench.settle_s)
        first = session.newest or session.tick()

        def reference(at: float) -> tuple[float, float]:
            x, y = asked[round(at * RATE_HZ)].tolist()
            return x, y

        acted = list(hold(session, self._controller, reference, seconds_to_actions(seconds)))
        samples = [first, *(sample for held in acted for sample in held.samples)]
        tail = [session.tick() for _ in range(EXTRA_TICKS)]
        # A tick's reading is the one at its end: the rest before the first action is row 0, and left out.
        issued = [(first.time - HALF_TICK_S, acted[0].target)]
        log = log_of([*samples, *tail], issued, len(samples), gap_of(self._bench))
        ticks = [target for held in acted for target in [held.target] * len(held.samples)]
        command = Command(*(np.array([t[i] for t in ticks], np.float32) for i in range(2)))
        reading = Reading(*(field[1:] for field in log.reading))
        return command, reading._replace(time=(reading.time - reading.time[0] + 1 / RATE_HZ).astype(np.float32))

    def _tell(self, done: float, note: str) -> None:
        if self._progress is not None:
            self._progress("evaluate", done, note)


def controller_for(controller: Path, bench: Bench) -> LoadedController:
    """Load a controller that is to act on this machine; raises RigError where it is for another fin."""
    loaded = load_controller(controller)
    check_fits(str(controller), loaded.limits, loaded.artifact.fin, bench)
    return loaded


def gap_of(bench: Bench) -> float:
    """Longest gap that a log may have [s]: what safety lets pass is bridged, too."""
    return max(GAP_S, bench.safety.stale_s, bench.safety.force_stale_s)


def bags_of(out: Path) -> Path:
    """The folder of recordings beside an output."""
    return out.absolute().with_name(f"{out.absolute().name}-bags")


def _check_claim(bags: Path, facts: dict[str, Any], resume: bool) -> None:
    """Raise ArtifactError where the folder of recordings holds others', or finished ones and `resume` is not asked."""
    state = bags / STATE
    wanted = json.loads(artifacts.dump_json(facts))
    if state.exists():
        before = artifacts.read_json(state)
        finished = any(bags.glob("*.parquet"))
        if finished and not resume:
            raise ArtifactError(
                f"{bags}: holds finished logs; go on with --resume, give another --out, or move it away"
            )
        if finished and before != wanted:
            differing = "; ".join(_differing(before, wanted)[:SHOWN]) or "collection"
            raise ArtifactError(
                f"{bags}: holds logs of another {differing}; resume with the same options and rig, or give another "
                "--out"
            )
    elif bags.exists() and any(bags.iterdir()):
        raise ArtifactError(f"{bags}: exists and holds no collection; give another --out")


def _differing(before: Any, now: Any, at: str = "") -> list[str]:
    """Each value that is another one, with both."""
    if not (isinstance(before, dict) and isinstance(now, dict)):
        return [] if before == now else [f"{at} ({json.dumps(before)} there, {json.dumps(now)} here)"]
    names = dict.fromkeys([*now, *before])
    inner = [_differing(before.get(name), now.get(name), f"{at}.{name}" if at else str(name)) for name in names]
    return [each for part in inner for each in part]


def _counts(config: CollectConfig) -> dict[str, int]:
    return {"train": config.logs, "test": config.test_logs}


def _commands(config: CollectConfig, name: str, limits: Limits) -> list[Target]:
    """Those that a plant would get: one a tick, and one more to begin with."""
    part, number = name.split("-")
    _, key = jax.random.split(key_of(config.seed, f"collect/{part}/{int(number)}"))
    commands = config.excitation(key, config.rows + 1, limits)
    angles, velocities = (np.asarray(channel, float).tolist() for channel in commands)
    return [Target(angle, velocity) for angle, velocity in zip(angles, velocities, strict=True)]


def _record(session: Session, bench: Bench, commands: list[Target], told: "_Told") -> Log:
    """Row k is what was read at tick k + 1 and the command that was issued right then."""
    session.activate()
    session.rest(bench.settle_s)
    samples: list[Sample] = []
    issued: list[tuple[float, Target]] = []
    for tick in range(len(commands) + EXTRA_TICKS):
        sample = session.tick()
        samples.append(sample)
        if tick < len(commands):
            if not issued or commands[tick] != issued[-1][1]:
                session.command(commands[tick])
                issued.append((sample.time - HALF_TICK_S, commands[tick]))
            told(tick, sample)
    session.deactivate()
    return log_of(samples[1:], issued, len(commands) - 1, gap_of(bench))


class _Told:
    """Progress of a collection, twice a second: rows, force and what is left."""

    def __init__(self, progress: Progress | None, name: str, index: int, of: int, rows: int, settle_s: float) -> None:
        self._progress, self._name, self._index, self._of = progress, name, index, of
        self._rows, self._settle = rows, settle_s

    def __call__(self, row: int, sample: Sample) -> None:
        if self._progress is None or (row % (RATE_HZ // 2) and row < self._rows):
            return
        done = (self._index + row / self._rows) / self._of
        left = ((self._of - self._index) * self._rows - row) / RATE_HZ + (self._of - self._index - 1) * self._settle
        x, y = sample.wrench[:2]
        note = f"{_time(left)} left, {self._name}: ({x:+.2f}, {y:+.2f}) N, {sample.angle:+.2f} rad"
        self._progress("collect", min(done, 1.0), note)


def _time(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min {rest:02d} s"


def _may_move(session: Session, confirm: Confirm, bench: Bench) -> None:
    """Ask; from here on Ctrl-C and its kin stop the fin before anything else."""
    confirm(bench)
    session.until_closed(stopped_by_signals(session.stop_request))
