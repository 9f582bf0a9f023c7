import jax
import jax.numpy as jnp
import numpy as np
import pytest

from softfin.core.errors import PlantError
from softfin.core.power import EC_MAX_30, motor_current
from softfin.core.quantities import PAPER_LIMITS, TICK_S, Command, Log
from softfin.data.collect import CollectConfig, collect_logs
from softfin.data.simulate import CHUNK_ROWS
from softfin.tank import Tank
from tests.plants import AnalyticFin, PlainFin

ROWS = CHUNK_ROWS + 501


@pytest.fixture(scope="module")
def config() -> CollectConfig:
    return CollectConfig(logs=4, test_logs=2, rows=ROWS, seed=3)


@pytest.fixture(scope="module")
def dataset(config, tmp_path_factory):
    return collect_logs(AnalyticFin(), config, tmp_path_factory.mktemp("collect") / "data")


def build_logs(dataset) -> list[Log]:
    return list(dataset.load([*dataset.train, *dataset.test]))


def assert_same(one: Log, other: Log, tolerance: float = 0.0) -> None:
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=0, atol=tolerance), one, other)


def check_speeds(log: Log, lag_s: float) -> np.ndarray:
    speed = (log.command.angle - log.reading.angle) / lag_s
    expected = np.clip(speed, -log.command.velocity, log.command.velocity)
    np.testing.assert_allclose(log.reading.velocity[1:], expected[:-1], atol=1e-4)
    return expected


def test_a_dataset_holds_the_logs_that_were_asked_for(dataset, config):
    assert (len(dataset.train), len(dataset.test)) == (4, 2)
    for log in build_logs(dataset):
        assert log.reading.force.shape == (ROWS, 2)
        np.testing.assert_array_equal(log.reading.time, np.arange(1, ROWS + 1) / 100)
    assert dataset.description["configuration"] == config.model_dump()
    assert dataset.description["provenance"]["seed"] == 3
    assert dataset.description["plant"] == "AnalyticFin"


def test_no_two_logs_are_alike(dataset):
    logs = build_logs(dataset)
    angles = {log.command.angle[:200].tobytes() for log in logs}
    noises = {log.reading.force[:200].tobytes() for log in logs}
    assert len(angles) == len(noises) == len(logs)


def test_the_command_of_a_row_shows_first_in_the_reading_of_the_next(dataset):
    """By the equation of the analytic fin: the speed of row k + 1 follows from the angle and the
    command of row k."""
    for log in build_logs(dataset):
        expected = check_speeds(log, AnalyticFin().lag_s)
        assert np.abs(log.reading.velocity[1:] - expected[1:]).max() > 1


def test_the_same_seed_gives_the_same_files_and_another_seed_others(dataset, config, tmp_path):
    again = collect_logs(AnalyticFin(), config, tmp_path / "again")
    other = collect_logs(AnalyticFin(), config.changed(["seed=4"]), tmp_path / "other")
    assert again.data_hash == dataset.data_hash
    assert other.data_hash != dataset.data_hash


@pytest.mark.parametrize("batch", [1, 3])
def test_a_log_does_not_depend_on_what_is_simulated_beside_it(dataset, config, tmp_path, batch):
    other = collect_logs(AnalyticFin(), config.changed([f"batch={batch}"]), tmp_path / "data")
    for one, another in zip(build_logs(dataset), build_logs(other), strict=True):
        assert_same(one, another, tolerance=1e-5)


def test_test_logs_are_recorded_from_the_plants_given_for_them(dataset, config, tmp_path):
    silent = AnalyticFin(gain=0.0, noise_n=0.0)
    strong = AnalyticFin(gain=5.0, noise_n=0.0)
    other = collect_logs(AnalyticFin(), config, tmp_path / "data", test_plants=[silent, strong])
    first, second = other.load(other.test)
    assert not first.reading.force.any()
    assert np.abs(second.reading.force).max() > 5
    for one, another in zip(dataset.load(dataset.train), other.load(other.train), strict=True):
        assert_same(one, another)


def test_plants_that_cannot_be_stacked_run_one_after_another(tmp_path):
    config = CollectConfig(logs=1, test_logs=2, rows=300)
    weak = AnalyticFin(gain=0.1)
    strong = AnalyticFin(gain=0.9)
    stacked = collect_logs(AnalyticFin(), config, tmp_path / "one", [weak, strong])
    mixed = collect_logs(AnalyticFin(), config, tmp_path / "two", [weak, PlainFin(0.9)])
    for one, other in zip(build_logs(stacked), build_logs(mixed), strict=True):
        assert_same(one, other, tolerance=1e-5)


def test_plants_that_differ_in_what_is_compiled_keep_their_difference(tmp_path):
    config = CollectConfig(logs=1, test_logs=2, rows=300)
    plants = [AnalyticFin(lag_s=0.05, noise_n=0.0), AnalyticFin(lag_s=0.5, noise_n=0.0)]
    logs = build_logs(collect_logs(AnalyticFin(), config, tmp_path / "data", plants))[-2:]
    for log, lag_s in zip(logs, (0.05, 0.5), strict=True):
        check_speeds(log, lag_s)


def test_progress_grows_to_all_rows(config, tmp_path):
    seen = []
    collect_logs(
        AnalyticFin(),
        config.changed(["batch=3"]),
        tmp_path / "data",
        progress=lambda *counts: seen.append(counts),
    )
    stages, done, notes = zip(*seen, strict=True)
    assert set(stages) == {"collect"}
    assert notes[-1] == f"{6 * ROWS:,} of {6 * ROWS:,} rows"
    assert done[-1] == 1
    assert all(np.diff(done) > 0)
    assert len(seen) == 4


def test_an_interrupt_leaves_nothing(config, tmp_path):
    def interrupt(stage: str, done: float, note: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        collect_logs(AnalyticFin(), config, tmp_path / "data", progress=interrupt)
    assert not any(tmp_path.iterdir())


class Broken(PlainFin):
    """A plant whose force is lost when the fin is far out."""

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(
            force=jnp.where(reading.angle[:, None] > 0.3, jnp.nan, reading.force)
        )


class Late(PlainFin):
    """A plant whose clock runs three times too slow."""

    def advance(self, state, command, ticks):
        state, reading = super().advance(state, command, ticks)
        return state, reading._replace(time=reading.time / 3)


def test_a_plant_that_gives_nan_is_named_with_the_row(tmp_path):
    with pytest.raises(PlantError, match=r"train/0000, row \d+: the plant's force is nan"):
        collect_logs(Broken(), CollectConfig(logs=1, test_logs=0, rows=500), tmp_path / "data")
    assert not any(tmp_path.iterdir())


def test_a_plant_whose_clock_is_wrong_is_refused(tmp_path):
    with pytest.raises(PlantError, match=r"row 0: .* time is 0\.0033 s"):
        collect_logs(Late(), CollectConfig(logs=1, test_logs=0, rows=500), tmp_path / "data")


def test_the_first_command_is_met_at_rest(dataset):
    """Row 1 was read one tick after rest at angle 0, so its angle is within one tick's travel."""
    for log in build_logs(dataset):
        assert 0 < abs(log.reading.angle[0]) <= PAPER_LIMITS.velocity_max * TICK_S + 1e-6


def test_the_kept_command_is_a_command(dataset):
    command: Command = build_logs(dataset)[0].command
    assert PAPER_LIMITS.velocity_min <= command.velocity.min()
    assert command.velocity.max() <= PAPER_LIMITS.velocity_max


def test_the_tank_records_torque_and_current_on_request(tmp_path):
    config = CollectConfig(logs=1, test_logs=0, rows=400, seed=1)
    tank = Tank()
    (plain,) = build_logs(collect_logs(tank, config, tmp_path / "plain"))
    (log,) = build_logs(collect_logs(tank, config.changed(["channels=true"]), tmp_path / "more"))
    assert plain.channels == {}
    assert sorted(log.channels) == ["current_a", "torque_nm"]
    np.testing.assert_allclose(log.reading.force, plain.reading.force, atol=0.05)
    # Over whole strokes from rest to rest, the drive delivers power to the water.
    torque, velocity = log.channels["torque_nm"], log.reading.velocity
    assert np.mean(torque * velocity) > 0
    # The current also accelerates the rotor and covers the losses of the gear.
    rotor = float(tank.drive.inertia) * np.gradient(velocity) / TICK_S
    current = motor_current(np.stack([torque, torque + rotor], axis=1), velocity, EC_MAX_30)
    assert np.corrcoef(current, log.channels["current_a"])[0, 1] > 0.9
    assert np.abs(log.channels["current_a"]).max() < 2.5


def test_a_plant_without_channels_cannot_record_them(tmp_path):
    config = CollectConfig(logs=1, test_logs=0, rows=10, channels=True)
    with pytest.raises(PlantError, match="AnalyticFin has no method measure"):
        collect_logs(AnalyticFin(), config, tmp_path / "data")
