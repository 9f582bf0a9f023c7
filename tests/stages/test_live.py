"""Logs and judgements from a fin that moves by itself, here an emulated one."""

import dataclasses
import json
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.control.family import save_family
from softfin.control.feedback import FeedbackConfig
from softfin.control.store import load_controller
from softfin.core.errors import ArtifactError, ConfigurationError, RigError, SafetyStop
from softfin.core.log_channels import CURRENT_CHANNEL, LOAD_CHANNELS
from softfin.core.plant import roll
from softfin.core.power import electrical_power, tick_velocity
from softfin.core.quantities import Command
from softfin.data.collect import CollectConfig, collect_logs
from softfin.data.recordings import open_logs
from softfin.emulation.clock import SimulatedClock
from softfin.evaluation.evaluate import EvaluateConfig
from softfin.rig.devices.epos2.protocol import State
from softfin.rig.record import load_record
from softfin.rig.rig import zero_force
from softfin.rig.robot_setup import RobotSetup
from softfin.rig.safety import SafetyConfig
from softfin.rig.stop import StopRequest
from softfin.stages.live import collect_live, evaluate_live, find_bags, log_from_samples
from softfin.storage.bag.messages import ESTIMATE, HALF_WIDTH, LEVEL
from softfin.storage.dataset import Dataset
from softfin.tank import Tank
from tests.control.folders import folder_option
from tests.explorer.families import random_family
from tests.gaits.known import save_known
from tests.rig.bags import counts_of, events_of
from tests.rig.machines import FreeFin
from tests.rig.rigs import SAFETY, emulated, robot_of, simulated, values_of

CONFIG = CollectConfig(logs=1, test_logs=1, rows=60, seed=3)


def yes(robot):
    """Nobody stands by."""


def no(robot):
    raise ConfigurationError("nothing moves without --arm")


def test_logs_are_recorded_one_by_one_and_a_stopped_collection_goes_on(tmp_path):
    out = tmp_path / "data"
    request = StopRequest()

    def stop_in_the_second(stage, done, note):
        if "test-" in note:
            request.ask("emergency_stop", "stopped by a key")

    with emulated() as (behind, robot):
        with pytest.raises(SafetyStop, match="stopped by a key"):
            collect_live(robot, out, CONFIG, yes, stop=request, progress=stop_in_the_second)
        assert behind.drive.state is State.SWITCH_ON_DISABLED
        assert not out.exists()
        bags = find_bags(out)
        assert sorted(path.name for path in bags.iterdir()) == [
            "collect.json",
            "test-000.mcap",
            "train-0000.mcap",
            "train-0000.parquet",
        ]
        assert events_of(bags / "test-000.mcap")[-1] == "stopped: emergency_stop: stopped by a key"
        first = (bags / "train-0000.parquet").read_bytes()

        with pytest.raises(ArtifactError, match="--resume"):
            collect_live(robot, out, CONFIG, yes)
        other = CONFIG.model_copy(update={"seed": 4})
        with pytest.raises(
            ArtifactError, match=r"different run \(configuration.seed was 3 and is 4\)"
        ):
            collect_live(robot, out, other, yes, resume=True)

        told = []
        data = collect_live(
            robot, out, CONFIG, yes, resume=True, progress=lambda *words: told.append(words)
        )
        again = collect_live(
            robot, out, CONFIG, yes, resume=True, progress=lambda *words: told.append("moved")
        )
    assert again.data_hash == data.data_hash
    assert "moved" not in told
    assert (bags / "train-0000.parquet").read_bytes() == first
    assert (bags / "test-000.cut-1.mcap").exists()
    assert (len(data.train), len(data.test)) == (1, 1)
    assert all(" left, test-000: (" in note and note.endswith(" rad") for _, _, note in told)
    described = json.loads((out / "dataset.json").read_text())
    assert described["fin"] == "emulated"
    assert described["counters"]["sensor_records"] > 0
    assert described["rig"]["drive"]["encoder_lines"] == 500
    log = next(iter(Dataset.open(out).load(data.train)))
    assert log.reading.time.shape == (60,)
    assert np.ptp(log.reading.angle) > 0.05
    assert sorted(log.channels) == sorted((CURRENT_CHANNEL, *LOAD_CHANNELS))
    assert (log.channels[CURRENT_CHANNEL] > 0).all()


def test_nothing_moves_and_nothing_is_written_where_nobody_confirms(tmp_path):
    with emulated() as (behind, robot):
        with pytest.raises(ConfigurationError, match="--arm"):
            collect_live(robot, tmp_path / "data", CONFIG, no)
        assert behind.drive.state is State.SWITCH_ON_DISABLED
        assert behind.fin.now().angle == 0.0
    assert list(tmp_path.iterdir()) == []


def test_a_controller_is_judged_on_a_fin_that_moves_by_itself(tmp_path):
    folder = folder_option("single", tmp_path)
    config = EvaluateConfig(references=((1.0, -1.0),), seconds=3, seeds=1)
    machine = FreeFin(SimulatedClock())
    robot = RobotSetup(machine, SafetyConfig.build(SAFETY, "safety"), settle_s=0.1)
    summary = evaluate_live(folder, robot, tmp_path / "out", config, yes)
    assert not machine.enabled
    assert machine.calls[-1] == "close"
    assert summary["references"][0]["reference_n"] == [1.0, -1.0]
    assert json.loads((tmp_path / "out" / "evaluation.json").read_text())["mean"] == summary["mean"]
    bag = next(find_bags(tmp_path / "out").glob("session-*.mcap"))
    active, rest, inactive = events_of(bag)
    assert (active, inactive) == ("active: free fin", "inactive")
    assert rest == "force at rest: (0.0000, 0.1000) N"
    # The bag's force is raw; what is imported from it is what the controller and the evaluation
    # got.
    (imported,) = open_logs(bag).logs
    np.testing.assert_allclose(imported.log.reading.force[:, 1], 0.0, atol=1e-6)


@pytest.mark.parametrize("job", ["evaluate", "collect"])
def test_a_log_is_computed_without_power(tmp_path, monkeypatch, job):
    """It takes longer than a tick may be late."""
    machine = FreeFin(SimulatedClock())
    robot = RobotSetup(machine, SafetyConfig.build(SAFETY, "safety"), settle_s=0.1)
    powered = []

    def computed(*given):
        powered.append(machine.enabled)
        return log_from_samples(*given)

    monkeypatch.setattr("softfin.stages.live.log_from_samples", computed)
    if job == "evaluate":
        config = EvaluateConfig(references=((1.0, -1.0),), seconds=3, seeds=1)
        evaluate_live(folder_option("single", tmp_path), robot, tmp_path / "out", config, yes)
    else:
        config = CollectConfig(logs=1, test_logs=0, rows=400)
        collect_live(robot, tmp_path / "out", config, yes)
    assert powered == [False]


def test_a_controller_of_another_fin_is_refused_before_anything_is_opened(tmp_path, monkeypatch):
    folder = folder_option("single", tmp_path)
    with emulated() as (_, robot):
        monkeypatch.setattr(robot.machine, "open", lambda: pytest.fail("opened"))
        monkeypatch.setattr("softfin.stages.live.load_controller", _of_fin("red"))
        with pytest.raises(RigError, match="trained for fin 'red'"):
            evaluate_live(folder, robot, tmp_path / "out", EvaluateConfig(), yes)


def _of_fin(fin):
    from softfin.control.store import load_controller

    def load(folder):
        loaded = load_controller(folder)
        return dataclasses.replace(loaded, artifact=dataclasses.replace(loaded.artifact, fin=fin))

    return load


def test_a_log_through_the_emulators_is_the_tanks_own(tmp_path):
    """The same commands to the same tank, once in a program and once behind drive and sensor."""
    tank = Tank()
    config = CollectConfig(logs=1, test_logs=0, rows=400, seed=5)
    with emulated(tank) as (_, robot):
        live = collect_live(robot, tmp_path / "live", config, yes)
    alone = collect_logs(tank, config, tmp_path / "alone")
    through, planned = (next(iter(data.load(data.train))) for data in (live, alone))
    # The commands are the same at the same rows, and nothing is ever late.
    for sent, meant in zip(through.command, planned.command, strict=True):
        np.testing.assert_array_equal(sent, meant)
    commands = Command(*(jnp.asarray(channel) for channel in through.command))
    _, own = jax.jit(lambda: roll(tank, tank.init(jax.random.key(0)), commands))()
    # What is seen of the emulated fin is one to two samples old, depending on when the loop starts.
    angle = np.asarray(own.angle)
    before = np.concatenate([angle[:1], angle[:-1]])
    ages = np.linspace(0, 1, 11)
    errors = [rmse(through.reading.angle, angle + age * (before - angle), 1) for age in ages]
    assert min(errors) < 0.003
    for axis in range(2):
        assert alike(through.reading.force[:, axis], own.force[:, axis], 1) > 0.99


@pytest.mark.parametrize("drive", ["epos2", "dynamixel"])
def test_torque_and_current_through_the_emulators_are_the_tanks_own(drive, tmp_path):
    tank = Tank()
    config = CollectConfig(logs=1, test_logs=0, rows=400, seed=5)
    with emulated(tank, drive) as (_, robot):
        live = collect_live(robot, tmp_path / "live", config, yes)
    alone = collect_logs(tank, config.changed(["channels=true"]), tmp_path / "alone")
    through, own = (next(iter(data.load(data.train))) for data in (live, alone))
    torque = through.channels["torque_nm"]
    current = through.channels["current_a"]
    assert rmse(torque, own.channels["torque_nm"], 1) < 0.06 * torque.std()
    assert alike(current, own.channels["current_a"], 1) > 0.98
    assert current.std() == pytest.approx(own.channels["current_a"].std(), rel=0.05)
    # The rotor is in the current but not in the torque; on average, it takes no power.
    constant_nm_a = robot.machine.torque_constant_nm_a
    assert alike(constant_nm_a * current, torque, 0) < 0.95
    power_w = np.mean(own.channels["torque_nm"] * own.reading.velocity)
    for motor_torque in (torque, constant_nm_a * current):
        mean_w = np.mean(motor_torque * through.reading.velocity)
        assert mean_w == pytest.approx(power_w, rel=0.15)
    # Both powers of the log are those of the tank.
    motor = robot.machine.motor
    powers = []
    for log in (through, own):
        velocity = log.reading.velocity
        electrical = electrical_power(log.channels["current_a"], tick_velocity(velocity), motor)
        powers.append([np.mean(log.channels["torque_nm"] * velocity), electrical.mean()])
    np.testing.assert_allclose(*powers, rtol=0.05)


def shifted(through, own, lag):
    """What came through later, over what was there; the first second of both settles."""
    return np.stack([through[100 + lag :], own[100 : len(own) - lag]])


def rmse(through, own, lag):
    one, other = shifted(through, own, lag)
    return float(np.sqrt(np.mean((one - other) ** 2)))


def alike(through, own, lag):
    """Correlation."""
    return float(np.corrcoef(shifted(through, own, lag))[0, 1])


def two_logs(robot, out, **options):
    config = CONFIG.model_copy(update={"logs": 2, "test_logs": 0})
    return collect_live(robot, out, config, yes, **options)


def pull(fin, x, y):
    """Add a force (x, y) [N] to what the sensor reads."""
    read = fin.now

    def pulled():
        motion = read()
        force_x, force_y, *others = motion.wrench
        return motion._replace(wrench=(force_x + x, force_y + y, *others))

    fin.now = pulled


def stopped_in_the_second_log(robot, out):
    request = StopRequest()

    def stop(stage, done, note):
        if "train-0001" in note:
            request.ask("emergency_stop", "stopped by a key")

    with pytest.raises(SafetyStop, match="stopped by a key"):
        two_logs(robot, out, stop=request, progress=stop)


@pytest.mark.parametrize(
    ("setting", "was", "value"),
    [("frame", "y,-x", "x,y"), ("cutoff_hz", 30.0, 20.0), ("serial", None, "FT1")],
)
def test_a_collection_goes_on_only_with_the_same_sensor_setup(setting, was, value, tmp_path):
    with emulated() as (_, robot):
        stopped_in_the_second_log(robot, tmp_path / "data")
        sensor = robot.configuration["sensor"] | {setting: value}
        changed = dataclasses.replace(robot, configuration=robot.configuration | {"sensor": sensor})
        expected = f"rig.sensor.{setting} was {was!r} and is {value!r}"
        with pytest.raises(ArtifactError, match=re.escape(expected)):
            two_logs(changed, tmp_path / "data", resume=True)


def test_a_collection_goes_on_with_drive_and_sensor_at_other_addresses(tmp_path):
    with emulated() as (_, robot):
        stopped_in_the_second_log(robot, tmp_path / "data")
        sensor = robot.configuration["sensor"] | {
            "address": "10.0.0.7",
            "http_port": 8080,
            "rdt_port": 50000,
        }
        # A Dynamixel's serial adapter may get another port.
        drive = robot.configuration["drive"] | {"port": "/dev/ttyUSB1"}
        devices = {"drive": drive, "sensor": sensor}
        moved = dataclasses.replace(robot, configuration=robot.configuration | devices)
        assert len(two_logs(moved, tmp_path / "data", resume=True).train) == 2


def test_a_collection_that_does_not_say_how_its_sensor_was_set_up_is_not_continued(tmp_path):
    out = tmp_path / "data"
    with emulated() as (_, robot):
        stopped_in_the_second_log(robot, out)
        state = find_bags(out) / "collect.json"
        claim = json.loads(state.read_text())
        del claim["rig"]["sensor"]
        state.write_text(json.dumps(claim))
        with pytest.raises(ArtifactError, match=r"different run \(.*rig\.sensor\.frame was None"):
            two_logs(robot, out, resume=True)


def test_each_log_keeps_serial_number_zero_and_force_at_rest_also_after_an_interruption(tmp_path):
    out = tmp_path / "data"
    file = tmp_path / "rig.yaml"
    warnings = []
    with emulated() as (behind, robot):
        robot.machine.config._file = file
        zero_force(robot.machine, 0.2)
        zero = load_record(file).force_zero
        pull(behind.fin, 0.4, 0.0)
        stopped_in_the_second_log(robot, out)
        pull(behind.fin, 0.0, 0.3)
        two_logs(robot, out, resume=True, warn=warnings.append)
        serial = robot.machine.sensor.identity["serial"]
    described = json.loads((out / "dataset.json").read_text())
    first = described["sensor_by_log"]["train-0000"]
    second = described["sensor_by_log"]["train-0001"]
    for state in (first, second):
        assert state["sensor_serial"] == serial is not None
        assert state["force_zero"] == zero.model_dump(mode="json")
    assert first["force_at_rest_n"] == pytest.approx([0.4, 0.0], abs=0.05)
    assert second["force_at_rest_n"] == pytest.approx([0.4, 0.3], abs=0.05)
    (warning,) = warnings
    assert warning.startswith("train-0001: the rest force differs by 0.3")
    assert described["sensor_warnings"] == warnings


def test_a_force_at_rest_that_hardly_changes_gets_no_warning(tmp_path):
    warnings = []
    with emulated() as (_, robot):
        two_logs(robot, tmp_path / "data", warn=warnings.append)
    assert warnings == []
    assert json.loads((tmp_path / "data" / "dataset.json").read_text())["sensor_warnings"] == []


@pytest.mark.parametrize(
    ("strength", "drift_n", "limits"), [(1.0, 0.05, ["limit 0.01 N"]), (60.0, 0.3, [])]
)
def test_the_allowed_drift_follows_the_peak_force_of_the_fin(tmp_path, strength, drift_n, limits):
    warnings = []
    with emulated(force_peak_n=500.0, force_sustained_n=400.0) as (behind, robot):
        robot = dataclasses.replace(robot, settle_s=1.0)
        read = behind.fin.now

        def stronger():
            state = read()
            return state._replace(wrench=tuple(strength * load for load in state.wrench))

        behind.fin.now = stronger
        stopped_in_the_second_log(robot, tmp_path / "data")
        pull(behind.fin, 0.0, drift_n)
        two_logs(robot, tmp_path / "data", resume=True, warn=warnings.append)
    assert [re.search(r"limit [\d.]+ N", warning)[0] for warning in warnings] == limits


def test_the_progress_has_more_decimals_for_a_small_fin(tmp_path):
    notes = []
    with emulated(force_peak_n=2.0, force_sustained_n=1.9) as (_, robot):
        two_logs(robot, tmp_path / "data", progress=lambda *words: notes.append(words[2]))
    assert all(re.search(r"\([+-]\d\.\d{3}, [+-]\d\.\d{3}\) N", note) for note in notes)


def judged_by_lines(tmp_path, uses, columns, transmit):
    """Warnings, and the bag, of gaits with feedback on a tank whose sensor sends lines."""
    folder = save_known(tmp_path / "gaits")
    loaded = load_controller(folder)
    save_family(folder, loaded, random_family(loaded), {"configuration": {"fins": 20}})
    config = EvaluateConfig(
        references=((1.5, 0.0),), seconds=8, seeds=1, feedback=FeedbackConfig(uses=uses)
    )
    lines = []
    with simulated(Tank(), sensor="lines") as behind:
        behind.sensor.transmit = transmit
        values = values_of(behind)
        del values["bus"]
        values["sensor"]["columns"] = columns
        del values["drive"]["torque_constant_nm_a"]
        robot = robot_of(behind, **values)
        evaluate_live(folder, robot, tmp_path / "out", config, yes, warn=lines.append)
    return lines, next(find_bags(tmp_path / "out").glob("*.mcap"))


def test_a_force_that_is_clipped_on_the_way_is_reported_and_the_estimate_is_recorded(tmp_path):
    def clip(line):
        count, x, y, torque = line.strip().split(b",")
        # The sensor is mounted so that its y is softfin's x.
        clipped = max(min(float(y), 0.4), -0.4)
        return (b"%s,%s,%.6f,%s\r\n" % (count, x, clipped, torque),)

    columns = ["count", "force_x", "force_y", "torque_z"]
    lines, bag = judged_by_lines(tmp_path, "both", columns, clip)
    assert sorted(line.split(":")[0] for line in lines) == ["force_x", "the motor current"]
    counts = counts_of(bag)
    for topic in (ESTIMATE, HALF_WIDTH, LEVEL):
        assert counts[topic] == 24


def test_feedback_from_a_torque_that_nobody_measures_goes_on_and_is_reported(tmp_path):
    columns = ["count", "force_x", "force_y", "skip"]
    lines, _ = judged_by_lines(tmp_path, "torque", columns, lambda line: (line,))
    (line,) = lines
    assert "drive.torque_constant_nm_a" in line
