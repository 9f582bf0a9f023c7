"""Stages on a real fin, which record logs and evaluate controllers in real time, one after the
other.

The folder ``NAME-bags``, next to the output folder NAME, contains the finished logs, from which an
interrupted collection resumes, and a ROS 2 bag of all data, which is written live and never
removed.
"""

import json
import math
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float

from softfin.control.controller import Controller, controller_clock
from softfin.control.store import load_controller, load_feedback
from softfin.core.errors import ArtifactError, DeviceError
from softfin.core.json_object import JsonObject
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS, VOLTAGE_CHANNEL
from softfin.core.progress import Progress, silent
from softfin.core.quantities import RATE_HZ, TICK_S, Command, Limits, Log, Reading
from softfin.core.randomness import named_key
from softfin.data.collect import CollectConfig
from softfin.data.importing.clocks import held_command, interpolated
from softfin.evaluation.evaluate import EvaluateConfig, evaluate_controllers
from softfin.evaluation.experiment import ExperimentRecording
from softfin.evaluation.results import EvaluationSummary
from softfin.gaits.reachable import PAPER_PEAK_N, force_decimals, round_size
from softfin.rig.device import drop_address
from softfin.rig.loop import run_controller
from softfin.rig.machine import Machine, Sample, Target
from softfin.rig.record import load_record
from softfin.rig.rig import Rig
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import Guard
from softfin.rig.session import MeasuredForce, Session, Warn
from softfin.rig.shaft_torque import ShaftTorque
from softfin.rig.stop import StopRequest
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset
from softfin.storage.log_file import read_log, write_log
from softfin.storage.paths import DATASET_PARTS
from softfin.storage.run_directory import check_same

Confirm = Callable[[RobotSetup], None]
"""Function that asks the operator whether the fin may move, and raises an error unless the answer
is yes."""

EXTRA_TICKS = 20
"""Minimum number of ticks read after the last row of a log; needed because the force filter delays
its output."""

HALF_TICK_S = TICK_S / 2
"""Time by which command stamps are moved back [s], so that tick jitter cannot move a command to the
next row."""

GAP_S = 0.05
"""Maximum gap between two readings of a device that is interpolated [s]. Even at 3 Hz, the motion
of a fin is smooth over this time."""

STATE = "collect.json"

DRIFT_N = 0.2
"""Change in the rest force since the first log of a collection above which softfin warns [N], for a
fin with the peak force of the paper's fin. The rest force is subtracted from each log, but a sensor
that drifts between logs also drifts within them."""


def collect_live(
    robot: RobotSetup,
    out: Path,
    config: CollectConfig,
    confirm: Confirm,
    *,
    resume: bool = False,
    overwrite: bool = False,
    stop: StopRequest | None = None,
    progress: Progress = silent,
    warn: Warn = lambda line: None,
) -> Dataset:
    """Record random motions of a real fin as a dataset (paper Sec. III-A), log by log.

    With `resume`, finished logs are kept. `warn` is called for each log whose rest force has
    changed, and at the end if many sensor records were lost or unusable. Raises SafetyStop if the
    fin had to be stopped; all data recorded until then are kept.
    """
    artifacts.check_vacant(out, overwrite or resume)
    bags = find_bags(out)
    metadata: JsonObject = {
        "configuration": config.model_dump(mode="json"),
        "fin": robot.fin,
        "rig": robot.configuration,
    }
    # A collection may resume with the sensor at a different address, but not with different
    # settings.
    claim = metadata | {"rig": _drop_addresses(robot.configuration)}
    names = _log_names(config)
    missing = [name for name in names if not (bags / f"{name}.parquet").exists()]
    # Checked before anything moves because collecting takes hours.
    sensor_states = _check_claim(bags, claim, resume)
    if resume and not overwrite and artifacts.is_kind(out, "dataset"):
        # The recordings belong to this collection, and the dataset is written only when all of them
        # are complete.
        return Dataset.open(out)
    artifacts.check_vacant(out, overwrite)
    if missing:
        # Two decimals with the default limit.
        decimals = force_decimals(robot.safety.force_peak_n) + 1
        guard = Guard(robot.safety, robot.machine.limits)
        with Session(robot.machine, guard, stop=stop, warn=warn) as session:
            confirm(robot)
            session.stop_on_signals()
            _write_state(bags, claim, sensor_states)
            for index, name in enumerate(missing):
                # Default arguments bind the index and name of this iteration.
                def report(row: int, sample: Sample, index: int = index, name: str = name) -> None:
                    # Remaining rows plus the rest period before each remaining log.
                    left = ((len(missing) - index) * config.rows - row) / RATE_HZ
                    left_s = timedelta(
                        seconds=round(left + (len(missing) - index - 1) * robot.settle_s)
                    )
                    force = ", ".join(f"{value:+.{decimals}f}" for value in sample.wrench[:2])
                    note = f"{left_s} left, {name}: ({force}) N, {sample.angle:+.2f} rad"
                    progress("collect", min((index + row / config.rows) / len(missing), 1.0), note)

                with session.recording(bags / f"{name}.mcap"):
                    log, rest_force = _record(session, robot, config, name, report)
                sensor_states[name] = _sensor_state(robot.machine) | {
                    "force_at_rest_n": [round(x, 4) for x in rest_force],
                    "force_peak_n": round(float(np.abs(log.reading.force).max()), 4),
                }
                # Written before the log: an existing log is treated as finished, so its sensor
                # state must already exist.
                _write_state(bags, claim, sensor_states)
                write_log(bags / f"{name}.parquet", log)
                if line := _drift_warning(sensor_states, names[0], name):
                    warn(line)
            metadata["counters"] = robot.machine.counters() | {
                "skipped_ticks": session.pace.skipped
            }
            metadata["clock"] = session.pace.to_dict()
    drifts = [_drift_warning(sensor_states, names[0], name) for name in names]
    description = {
        "plant": robot.machine.name,
        "plant_identity": robot.machine.name,
        "commands": {"excitation": "random"},
        "bags": bags.name,
        "sensor_by_log": sensor_states,
        "sensor_warnings": [line for line in drifts if line is not None],
        "provenance": artifacts.provenance(seed=config.seed),
        **metadata,
    }
    logs = [bags / f"{name}.parquet" for name in names]
    train = map(read_log, logs[: config.logs])
    test = map(read_log, logs[config.logs :])
    return write_dataset(out, train, test, description, overwrite)


def evaluate_live(
    controller: Path,
    robot: RobotSetup,
    out: Path,
    config: EvaluateConfig,
    confirm: Confirm,
    *,
    overwrite: bool = False,
    stop: StopRequest | None = None,
    progress: Progress = silent,
    warn: Warn = lambda line: None,
) -> EvaluationSummary:
    """Evaluate a controller on a real fin (paper Sec. IV-B, Table II) in the same way as
    `softfin.evaluate` on a simulated plant."""
    artifacts.check_vacant(out, overwrite)
    loaded = load_controller(controller)
    robot.check_fits(str(controller), loaded.limits, loaded.artifact.fin)
    config = config.model_copy(update={"feedback": robot.feedback_settings(config.feedback)})
    acting = load_feedback(controller, loaded, config.feedback)
    guard = Guard(robot.safety, robot.machine.limits, loaded.artifact.training_range)
    bag = find_bags(out) / f"session-{datetime.now().astimezone():%Y%m%d-%H%M%S}.mcap"
    with Session(robot.machine, guard, stop=stop, warn=warn) as session:
        confirm(robot)
        session.stop_on_signals()
        with session.recording(bag):
            uses = None if config.feedback is None else config.feedback.uses
            torque = ShaftTorque(session, warn, uses)
            target = LiveFin(session, acting, robot, progress, torque)
            metadata = {"plant": str(target), "randomization": None}
            return evaluate_controllers(
                [controller], target, config, out, metadata, overwrite=overwrite
            )


class LiveFin:
    """A real fin and its controller, as a `RealTime` target of an evaluation."""

    def __init__(
        self,
        session: Session,
        controller: Controller,
        robot: RobotSetup,
        progress: Progress,
        shaft_torque: ShaftTorque,
    ) -> None:
        self.limits = Limits(*robot.machine.limits)
        self._session = session
        self._clock = controller_clock(controller)
        self._controller = controller
        self._robot = robot
        self._progress = progress
        self._shaft_torque = shaft_torque

    def __str__(self) -> str:
        return self._robot.machine.name

    def experiments(
        self, references: Float[np.ndarray, "references *ticks 2"], seconds: int, repetitions: int
    ) -> ExperimentRecording:
        """Run every reference `repetitions` times from rest, one run after the other."""
        runs: list[tuple[Command, Reading, np.ndarray]] = []
        shape = (len(references), repetitions)
        for index, repetition in np.ndindex(shape):
            note = f"reference {index + 1} of {len(references)}, repetition {repetition + 1}"
            self._progress("evaluate", len(runs) / (len(references) * repetitions), note)
            runs.append(
                self._one(np.broadcast_to(references[index], (seconds * RATE_HZ, 2)), seconds)
            )
        self._progress("evaluate", 1.0, "")
        command, reading, power = jax.tree.map(
            lambda *parts: np.stack(parts).reshape(*shape, *parts[0].shape), *runs
        )
        return ExperimentRecording(references, command, reading, clock=self._clock, power=power)

    def _one(
        self, asked: Float[np.ndarray, "ticks 2"], seconds: int
    ) -> tuple[Command, Reading, Float[np.ndarray, "ticks 2"]]:
        session = self._session
        session.activate()
        zero = session.rest(self._robot.settle_s)
        first = session.newest or session.tick()

        def reference(at: float) -> tuple[float, float]:
            x, y = asked[round(at * RATE_HZ)].tolist()
            return x, y

        results = list(
            run_controller(
                session,
                self._controller,
                reference,
                self._clock.actions_within(seconds * RATE_HZ),
                zero,
                self._shaft_torque,
            )
        )
        samples = [first, *(sample for result in results for sample in result.samples)]
        tail = [session.tick() for _ in range(extra_ticks(self._robot))]
        # Power off first: resampling ten minutes of samples takes longer than the maximum delay of
        # a tick.
        session.deactivate()
        # Readings are taken at the ends of ticks, so row 0, at rest before the first action, is
        # dropped below.
        issued = [(first.time - HALF_TICK_S, results[0].target)]
        log = log_from_samples([*samples, *tail], issued, len(samples), longest_gap(self._robot))
        ticks = [result.target for result in results for _ in result.samples]
        reading = Reading(*(field[1:] for field in log.reading))
        time = (reading.time - reading.time[0] + 1 / RATE_HZ).astype(np.float32)
        reading = reading._replace(time=time, force=reading.force - np.array(zero, np.float32))
        # The last action may end later.
        end = seconds * RATE_HZ
        reading = Reading(*(field[:end] for field in reading))
        power = np.array([result.power for result in results for _ in result.samples])
        return Command(*np.array(ticks[:end], np.float32).T), reading, power[:end]


def longest_gap(robot: RobotSetup) -> float:
    """Return the maximum gap in a log [s]; gaps that the safety limits allow are also
    interpolated."""
    return max(GAP_S, robot.safety.stale_s, robot.safety.force_stale_s)


def extra_ticks(robot: RobotSetup) -> int:
    """Return the number of ticks to read after the last row of a log until its force is known,
    given the lag of the force that the safety limits allow."""
    return max(EXTRA_TICKS, math.ceil(robot.safety.force_stale_s * RATE_HZ))


def find_bags(out: Path) -> Path:
    """Return the recordings folder next to an output folder."""
    return out.absolute().with_name(f"{out.absolute().name}-bags")


def log_from_samples(
    samples: Sequence[Sample],
    issued: Sequence[tuple[float, Target]],
    rows: int,
    gap_s: float = GAP_S,
) -> Log:
    """Resample drive and sensor onto a common 100 Hz grid that starts at the first sample; this
    removes the jitter of the loop.

    `issued` contains the time [s] and target of each command. The force filter delays its output,
    so `samples` must extend a little beyond the last row. The log has channels for motor current
    and supply voltage, if measured, and for the rest of the wrench. Raises DeviceError if the
    samples end early or have a gap longer than `gap_s`.
    """
    # The force has its own times because the sensor filter delays it relative to the angle.
    grid = samples[0].time + TICK_S * np.arange(rows)
    # NaN if current or voltage is not measured.
    drive = np.array([(s.time, s.angle, s.velocity, s.current, s.voltage) for s in samples], float)
    angle, velocity, current, voltage = _resample(drive, grid, "angle", gap_s)
    wrenches = np.array([(s.force_time, *s.wrench) for s in samples])
    x, y, *loads = _resample(wrenches, grid, "force", gap_s)
    # Sensors report zero for loads that they do not measure.
    channels = {name: load for name, load in zip(LOAD_CHANNELS, loads, strict=True) if load.any()}
    electrical = {CURRENT_CHANNEL: current, VOLTAGE_CHANNEL: voltage}
    channels |= {name: values for name, values in electrical.items() if np.isfinite(values).all()}
    times = np.array([time for time, _ in issued])
    targets = np.array([target for _, target in issued], float)
    command = Command(
        *(held_command(times, channel, grid).astype(np.float32) for channel in targets.T)
    )
    return Log(
        command,
        Reading(TICK_S * np.arange(1, rows + 1), angle, velocity, np.stack([x, y], axis=1)),
        channels,
    )


def _resample(points: np.ndarray, grid: np.ndarray, name: str, gap_s: float) -> list[np.ndarray]:
    # A device may repeat a reading, and interpolation needs increasing times.
    points = points[np.diff(points[:, 0], prepend=-np.inf) > 0]
    time = points[:, 0]
    # Gaps between readings within the grid, including the gaps at both ends.
    within = time[(time > grid[0]) & (time < grid[-1])]
    gaps = np.diff(np.concatenate([[min(time[0], grid[0])], within, [grid[-1]]]))
    if time[0] > grid[0] + gap_s or time[-1] < grid[-1] or gaps.max() > gap_s:
        # Start of the longest gap, in seconds from the start of the log.
        place = 0.0 if time[0] > grid[0] + gap_s else gaps[: gaps.argmax()].sum()
        raise DeviceError(
            f"no {name} for {gaps.max() * 1e3:.0f} ms at {place:.2f} s of the log (limit "
            f"{gap_s * 1e3:.0f} ms); run softfin rig check, then record this log again with "
            "--resume"
        )
    return [interpolated(time, values, grid).astype(np.float32) for values in points.T[1:]]


def _log_names(config: CollectConfig) -> list[str]:
    """Return the names of all logs of a collection, training logs first."""
    names = []
    for part, count in (("train", config.logs), ("test", config.test_logs)):
        digits = DATASET_PARTS[part]
        names += [f"{part}-{index:0{digits}d}" for index in range(count)]
    return names


def _drop_addresses(configuration: JsonObject) -> JsonObject:
    """Return the configuration without the addresses of its devices."""
    kept = {name: part for name, part in configuration.items() if name != "bus"}
    for device in ("drive", "sensor"):
        if device in kept:
            kept[device] = drop_address(kept[device])
    return kept


def _sensor_state(machine: Machine) -> JsonObject:
    """Return the serial number of the sensor calibration, the last sensor zero, and the delay for
    which the force is corrected [s]; None for entries that a machine lacks."""
    # Only a rig owns its sensor; with ROS 2, the sensor belongs to a different program.
    if not isinstance(machine, Rig):
        return {"sensor_serial": None, "force_zero": None, "force_delay_s": None}
    force_zero = load_record(machine.config.file).force_zero
    return {
        "sensor_serial": machine.sensor.identity.get("serial"),
        "force_zero": None if force_zero is None else force_zero.model_dump(mode="json"),
        "force_delay_s": round(machine.sensor.delay_s, 5),
    }


def _drift_warning(sensor_states: JsonObject, first_name: str, name: str) -> str | None:
    """Return a warning if the rest force has changed since the first log, relative to the peak
    force of the log."""
    first_n, now_n = (np.array(sensor_states[log]["force_at_rest_n"]) for log in (first_name, name))
    drift = float(np.linalg.norm(now_n - first_n))
    limit = DRIFT_N * round_size(sensor_states[name]["force_peak_n"] / PAPER_PEAK_N)
    if drift <= limit:
        return None
    return (
        f"{name}: the rest force differs by {drift:.2g} N from the rest force of {first_name} "
        f"(limit {limit:g} N); let the sensor and the water reach the same temperature, and check "
        "that nothing touches the fin"
    )


def _write_state(bags: Path, claim: JsonObject, sensor_states: JsonObject) -> None:
    state = claim | {"sensor_by_log": sensor_states}
    artifacts.write_file(bags / STATE, artifacts.dump_json(state))


def _check_claim(bags: Path, claim: JsonObject, resume: bool) -> JsonObject:
    """Return the sensor state of each finished log; raises ArtifactError if the folder contains
    other recordings, or if it contains finished logs and `resume` is not set."""
    state = bags / STATE
    if not state.exists():
        if bags.exists() and any(bags.iterdir()):
            raise ArtifactError(
                f"{bags}: already exists and is not a collection; choose a different --out"
            )
    elif any(bags.glob("*.parquet")):
        if not resume:
            raise ArtifactError(
                f"{bags}: contains finished logs; continue with --resume, choose a different "
                "--out, or move the folder away"
            )
        # Convert to JSON and back so that tuples and numbers compare equal to the contents of the
        # file.
        before = artifacts.read_json(state)
        sensor_states: JsonObject = before.pop("sensor_by_log", {})
        now = json.loads(artifacts.dump_json(claim))
        check_same(bags, before, now, "use the same options and rig, or choose a different --out")
        return sensor_states
    return {}


def _record(
    session: Session,
    robot: RobotSetup,
    config: CollectConfig,
    name: str,
    report: Callable[[int, Sample], None],
) -> tuple[Log, MeasuredForce]:
    """Record a log; row k contains the reading of tick k + 1 and the command issued at that time.

    Returns the log and the rest force before it [N], which is already subtracted from the force.
    """
    part, number = name.split("-")
    _, key = jax.random.split(named_key(config.seed, f"collect/{part}/{int(number)}"))
    # As for a simulated plant, there is one command per tick and an initial command.
    sampled = config.excitation(key, config.rows + 1, robot.machine.limits)
    commands = [Target(*command) for command in np.stack(sampled, axis=1).astype(float).tolist()]
    session.activate()
    zero = session.rest(robot.settle_s)
    samples: list[Sample] = []
    issued: list[tuple[float, Target]] = []
    for tick in range(len(commands) + extra_ticks(robot)):
        sample = session.tick()
        samples.append(sample)
        # The drive holds a command until the next one, so only changes are sent.
        if tick < len(commands):
            if not issued or commands[tick] != issued[-1][1]:
                session.command(commands[tick])
                issued.append((sample.time - HALF_TICK_S, commands[tick]))
            # Report progress twice per second, and at the end of the log.
            if tick % (RATE_HZ // 2) == 0 or tick >= config.rows:
                report(tick, sample)
    session.deactivate()
    log = log_from_samples(samples[1:], issued, len(commands) - 1, longest_gap(robot))
    return log._replace(
        reading=log.reading._replace(force=log.reading.force - np.array(zero, np.float32))
    ), zero
