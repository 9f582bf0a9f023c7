import jax
import numpy as np
import pytest

from softfin.core.errors import ArtifactError, LogError, RunError
from softfin.storage import artifact as artifacts
from softfin.storage.run_directory import LOG, TRAINING_LOG, RunDirectory, read_training_log
from softfin.surrogate import FitConfig, load_surrogate, save_surrogate
from softfin.surrogate.paper import fit
from softfin.surrogate.paper.fit import PaperLearner, fit_paper, window_starts
from tests.full_disk import check_that_a_full_disk_stops, needs_full_device
from tests.surrogate import small

CONFIG = FitConfig(
    posnet=small.POSNET, forcenet=small.FORCENET, epochs=4, batch=32, learning_rate=3e-3
)
LOGS = [small.log(rows=600, seed=seed) for seed in range(5)]


def weights_of(surrogate):
    return jax.tree.leaves((surrogate.posnet, surrogate.forcenet))


def same_weights(one, other):
    return all(
        np.array_equal(a, b) for a, b in zip(weights_of(one), weights_of(other), strict=True)
    )


class Killed(BaseException):
    pass


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A fit that was not interrupted, and its log."""
    run_directory = RunDirectory(tmp_path_factory.mktemp("whole") / "s", {"a": 1})
    return fit_paper(LOGS, CONFIG, 0, run_directory), read_training_log(run_directory.folder / LOG)


def test_windows_never_reach_from_one_log_into_the_next():
    np.testing.assert_array_equal(window_starts([5, 2, 4], window=3), [0, 1, 7])


def test_fitting_learns_angle_and_forces(tmp_path):
    test = small.log(rows=600, seed=99)
    fitted = fit_paper(LOGS, CONFIG.changed(["epochs=24"]), 0, RunDirectory(tmp_path / "s", {}))
    predictions = fitted.predict_angle(test), fitted.predict_force(test, free_running=True)
    for predicted, measured in zip(
        predictions, (test.reading.angle, test.reading.force), strict=True
    ):
        error = predicted - measured[small.WINDOW :]
        spread = measured.std()
        assert np.sqrt(np.mean(error**2)) < 0.4 * spread


def test_held_out_logs_do_not_reach_scaling_or_training(tmp_path, whole):
    """They choose the epoch whose weights are kept, and nothing else: all epochs learn alike."""
    last = LOGS[-1]
    run_directory = RunDirectory(tmp_path / "s", {})
    changed = last._replace(
        reading=last.reading._replace(force=last.reading.force * np.float32(100))
    )
    fitted = fit_paper([*LOGS[:-1], changed], CONFIG, 0, run_directory)
    histories = whole[1], read_training_log(run_directory.folder / LOG)
    for name, alike in (
        ("train/posnet_mse", True),
        ("train/forcenet_mse", True),
        ("held_out/forcenet_mse", False),
    ):
        one, other = ([entry[name] for entry in history] for history in histories)
        assert len(one) == len(other) == CONFIG.epochs
        assert (one == other) == alike
    assert fitted.scaling == whole[0].scaling


def test_the_best_weights_are_kept_not_the_last(tmp_path, monkeypatch):
    monkeypatch.setattr(fit, "PATIENCE", 2)
    config = CONFIG.changed(["epochs=30", "learning_rate=0.05"])
    run_directory = RunDirectory(tmp_path / "s", {})
    fitted = fit_paper(LOGS, config, 0, run_directory)
    history = read_training_log(run_directory.folder / LOG)
    least = min(entry["held_out/forcenet_mse"] for entry in history)
    predicted = fitted.predict_force(LOGS[-1], free_running=False)
    held = LOGS[-1].reading.force[small.WINDOW :]
    scale = np.array([fitted.scaling.channels[name].scale for name in ("force_x_n", "force_y_n")])
    assert np.mean(((predicted - held) * scale) ** 2) == pytest.approx(least, rel=1e-3)
    assert least < history[-1]["held_out/forcenet_mse"]


def test_a_killed_fit_resumes_to_the_same_weights(tmp_path, whole):
    def killer(stage, done, note):
        if done > 0.6:
            raise Killed

    with pytest.raises(Killed):
        fit_paper(LOGS, CONFIG, 0, RunDirectory(tmp_path / "cut", {"a": 1}), killer)
    resumed_from = []
    run_directory = RunDirectory(tmp_path / "cut", {"a": 1}, resume=True)
    resumed = fit_paper(
        LOGS, CONFIG, 0, run_directory, lambda stage, done, note: resumed_from.append(done)
    )
    assert min(resumed_from) > 0.5
    assert same_weights(whole[0], resumed)
    log = read_training_log(run_directory.folder / LOG)
    assert [entry["step"] for entry in log] == [1, 2, 3, 4]


def test_unfinished_work_is_neither_lost_nor_mixed_up(tmp_path):
    run_directory = RunDirectory(tmp_path / "s", {"seed": 0})
    run_directory.save({"x": np.zeros(2)}, {"epoch": 1})
    with pytest.raises(ArtifactError, match=r"--resume, .*--overwrite"):
        RunDirectory(tmp_path / "s", {"seed": 0})
    with pytest.raises(ArtifactError, match="seed was 0 and is 1"):
        RunDirectory(tmp_path / "s", {"seed": 1}, resume=True)
    anew = RunDirectory(tmp_path / "s", {"seed": 1}, overwrite=True)
    assert anew.load({"x": np.zeros(2)}) is None


def test_the_training_log_is_kept(tmp_path):
    run_directory = RunDirectory(tmp_path / "s", {})
    run_directory.log().write(1, loss=0.5)
    run_directory.keep_log(tmp_path / "kept")
    kept = tmp_path / "kept" / TRAINING_LOG
    assert read_training_log(kept / LOG) == [{"step": 1, "loss": 0.5}]


def test_damaged_work_is_refused_by_name(tmp_path):
    run_directory = RunDirectory(tmp_path / "s", {})
    run_directory.save({"x": np.zeros(2)}, {})
    (run_directory.folder / "checkpoint.safetensors").write_bytes(b"short")
    with pytest.raises(ArtifactError, match=r"checkpoint\.safetensors: damaged .*--overwrite"):
        RunDirectory(tmp_path / "s", {}, resume=True)


def test_logs_shorter_than_a_batch_are_refused(tmp_path):
    short = [small.log(rows=40), small.log(rows=40)]
    with pytest.raises(LogError, match="fewer than one batch of 32"):
        fit_paper(short, CONFIG, 0, RunDirectory(tmp_path / "s", {}))


def test_a_column_that_never_changes_is_named(tmp_path):
    still = [
        log._replace(command=log.command._replace(velocity=np.full(600, 2, np.float32)))
        for log in LOGS
    ]
    with pytest.raises(LogError, match="column command_velocity_rad_s is 2 in every row"):
        fit_paper(still, CONFIG, 0, RunDirectory(tmp_path / "s", {}))


def test_a_loss_that_explodes_stops_the_fit(tmp_path, monkeypatch):
    start = PaperLearner.start

    def far_off(learner, key):
        state = start(learner, key)
        return state._replace(nets=jax.tree.map(lambda x: x * np.float32(1e38), state.nets))

    monkeypatch.setattr(PaperLearner, "start", far_off)
    with pytest.raises(RunError, match="NaN or infinite; lower --learning-rate"):
        fit_paper(LOGS, CONFIG, 0, RunDirectory(tmp_path / "s", {}))


def test_a_stored_surrogate_is_the_same_surrogate(tmp_path):
    plant = small.surrogate()
    save_surrogate(tmp_path / "s", plant, None, artifacts.provenance(seed=0))
    loaded = load_surrogate(tmp_path / "s")
    assert same_weights(plant, loaded)
    assert loaded.scaling == plant.scaling
    assert loaded.posnet.config == plant.posnet.config


@pytest.mark.parametrize("cut", [0, 7, 100, 2000])
def test_truncated_weights_are_refused_by_name(tmp_path, cut):
    save_surrogate(tmp_path / "s", small.surrogate(), None, {})
    weights = tmp_path / "s" / artifacts.WEIGHTS
    weights.write_bytes(weights.read_bytes()[:cut])
    with pytest.raises(ArtifactError, match=r"weights\.safetensors: truncated or damaged"):
        load_surrogate(tmp_path / "s")


def test_a_folder_that_is_no_surrogate_is_refused(tmp_path):
    with pytest.raises(ArtifactError, match=r"not a surrogate: it contains no surrogate\.json"):
        load_surrogate(tmp_path)
    (tmp_path / "surrogate.json").write_text('{"rate_hz": 50}')
    (tmp_path / artifacts.WEIGHTS).write_bytes((8).to_bytes(8, "little") + b"{}      ")
    with pytest.raises(ArtifactError, match="50 Hz"):
        load_surrogate(tmp_path)


@needs_full_device
def test_a_full_disk_stops_the_fit_with_an_error(tmp_path):
    run_directory = RunDirectory(tmp_path / "s", {})
    check_that_a_full_disk_stops(
        lambda: fit_paper(LOGS, CONFIG, 0, run_directory), run_directory.folder
    )
