import json
from pathlib import Path

import numpy as np
import pytest

from softfin.cli import main
from softfin.core.action_clock import ActionClock
from softfin.core.errors import ConfigurationError
from softfin.core.plant_identity import identity
from softfin.stages.controllers import find_clock
from softfin.stages.surrogates import issue_line
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import write_dataset
from softfin.surrogate import (
    FitConfig,
    StreamingConfig,
    StreamingSurrogate,
    load_surrogate,
    save_surrogate,
)
from softfin.surrogate.registry import find_architecture
from softfin.surrogate.streaming.refit import Refit
from tests.surrogate import small as paper
from tests.surrogate.streaming import small


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit") / "dataset"
    logs = [small.recorded(300, seed) for seed in range(3)]
    write_dataset(folder, logs, [small.recorded(300, 9)], {})
    return str(folder)


@pytest.fixture
def asked(monkeypatch):
    """Arguments of each fit, none of which is done; it returns a surrogate with random weights."""
    configs = []

    def fit(logs, config, seed, run_directory, progress):
        run_directory.log()
        configs.append((config, seed, len(logs)))
        return small.surrogate()

    fit_with(monkeypatch, fit)
    return configs


def fit_with(monkeypatch, fit):
    """Every architecture is fitted by this function."""
    monkeypatch.setattr(
        "softfin.stages.surrogates.find_architecture",
        lambda model: find_architecture(model)._replace(fit=fit),
    )


def run(capsys, *words):
    capsys.readouterr()
    main(words)
    return capsys.readouterr().out


def fails(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    # Before it stands how far the run had come.
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("softfin")
    return line


@pytest.mark.parametrize(
    ("words", "config"),
    [
        ([], StreamingConfig()),
        (
            ["--model", "streaming", "--members", "2", "--drive.units", "3"],
            StreamingConfig(members=2, drive={"units": 3}),
        ),
        (["--model", "paper", "--epochs", "3"], FitConfig(epochs=3)),
    ],
)
def test_the_model_is_the_one_that_is_asked_for(capsys, tmp_path, dataset, asked, words, config):
    out = tmp_path / "s"
    said = json.loads(
        run(capsys, "fit", dataset, *words, "--seed", "4", "--out", str(out), "--json")
    )
    assert asked == [(config, 4, 3)]
    assert said["model"] == "streaming"
    description = artifacts.load_description(out, "surrogate")
    assert description["configuration"] == json.loads(json.dumps(config.model_dump(mode="json")))
    assert description["scores"] == said["table_i"]


@pytest.mark.parametrize(("floor_n", "warned"), [(0.01, False), (50.0, True)])
def test_noise_that_hides_the_force_is_a_warning(
    capsys, tmp_path, dataset, monkeypatch, floor_n, warned
):
    def fit(logs, config, seed, run_directory, progress):
        run_directory.log()
        fitted = small.surrogate()
        interval = fitted.interval.model_copy(update={"floor_n": floor_n})
        return StreamingSurrogate(fitted.members, fitted.limits, interval, fitted.familiarity)

    fit_with(monkeypatch, fit)
    out = tmp_path / "s"
    main(["fit", dataset, "--out", str(out), "--json"])
    captured = capsys.readouterr()
    found = json.loads(captured.out)["warning"]
    assert (found is not None) == warned
    assert load_surrogate(out).mean_force_noise_n == floor_n
    if found is not None:
        assert found.startswith(f"{out}: noise hides the force: ")


def test_people_are_told_table_i(capsys, tmp_path, dataset, asked):
    text = run(capsys, "fit", dataset, "--out", str(tmp_path / "s"))
    assert "Drive networks, commands to angle" in text
    assert "Force networks, free-running behind the drive networks" in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--seed", "2147483648"], "--seed 2147483648: must be an integer from 0"),
        (["--epochs", "3"], "--epochs: unknown option"),
        (["--force.wakes", "3"], "unknown key 'force.wakes'; did you mean 'wake'?"),
        (["--burn-in", "900"], "burn_in must be less than ticks = 250"),
        (
            ["--ticks", "300", "--burn-in", "10"],
            "has 300 rows; at least 321 are required; record longer",
        ),
    ],
)
def test_what_cannot_be_fitted_is_one_line_and_leaves_nothing(
    capsys, tmp_path, dataset, words, expected
):
    assert expected in fails(capsys, "fit", dataset, *words, "--out", str(tmp_path / "s"))
    assert not (tmp_path / "s").exists()


def faulty(index):
    log = small.recorded(300, index)
    return log._replace(reading=log.reading._replace(angle=np.degrees(log.reading.angle)))


def test_errors_that_an_import_ignored_do_not_stop_the_fit(capsys, tmp_path, asked):
    for accepted in (False, True):
        metadata = {"options": {"ignore_errors": ["degrees"] if accepted else []}}
        write_dataset(tmp_path / "d", [faulty(1), faulty(2)], [], metadata, overwrite=accepted)
        words = ["fit", str(tmp_path / "d"), "--out", str(tmp_path / "s")]
        if accepted:
            main(words)
        else:
            assert "use --ignore-errors degrees to use these logs anyway" in fails(capsys, *words)
    assert len(asked) == 1
    (line,) = [line for line in capsys.readouterr().out.splitlines() if "softfin inspect" in line]
    assert line.startswith(f"{tmp_path / 'd'}: 1 error")


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        (
            {"error": 0, "warning": 2, "note": 1},
            "d: 2 warnings, 1 note; run softfin inspect d to list them\n",
        ),
        ({"error": 0, "warning": 0, "note": 3}, ""),
    ],
)
def test_warnings_are_told_in_one_line_and_notes_alone_are_not(counts, line):
    assert issue_line(counts, Path("d")) == line


def test_one_log_is_enough_because_its_end_is_held_out(capsys, tmp_path, asked):
    write_dataset(tmp_path / "one", [small.recorded(2000)], [], {})
    text = run(capsys, "fit", str(tmp_path / "one"), "--out", str(tmp_path / "s"))
    assert "in 1 held-out log" in text


@pytest.fixture
def start(tmp_path):
    """Folder of a surrogate to refit."""
    path = tmp_path / "start"
    save_surrogate(path, small.surrogate(), None, {}, stroke_s=0.31, fin="blue")
    return path


@pytest.mark.parametrize("is_better", [False, True])
def test_a_refit_states_its_start_its_logs_and_what_is_kept(
    capsys, tmp_path, dataset, start, monkeypatch, is_better
):
    fitted = small.surrogate(seed=int(is_better))
    monkeypatch.setattr(Refit, "fit", lambda self, *_: fitted)
    out = tmp_path / "s"
    words = ["fit", dataset, "--start", str(start), "--out", str(out)]
    text = run(capsys, *words)
    (line,) = [line for line in text.splitlines() if line.endswith("is kept")]
    assert line.startswith(f"{start}: error of the predicted force ")
    assert line.endswith("the refit is kept" if is_better else f"{start} is kept")
    description = artifacts.load_description(out, "surrogate")
    refit = description["provenance"]["refit"]
    assert refit["start"] == str(start)
    assert refit["identity"] == identity(load_surrogate(start))
    assert refit["minutes"] == pytest.approx(3 * 300 / 6000)
    assert (refit["scores"] == description["scores"]) == (not is_better)
    assert (description["stroke_s"], description["fin"]) == (0.31, "blue")
    said = json.loads(run(capsys, *words, "--resume", "--json"))
    assert said["refit"] == refit


def test_a_refit_with_a_different_start_is_not_continued(
    capsys, tmp_path, dataset, start, monkeypatch
):
    monkeypatch.setattr(Refit, "fit", lambda self, *_: small.surrogate())
    words = ["fit", dataset, "--start", str(start), "--out", str(tmp_path / "s"), "--resume"]
    run(capsys, *words)
    save_surrogate(start, small.surrogate(seed=1), None, {}, overwrite=True)
    assert "start was" in fails(capsys, *words)


@pytest.mark.parametrize("model", ["paper", "streaming"])
def test_only_streaming_surrogates_are_refitted(capsys, tmp_path, dataset, start, model):
    save_surrogate(tmp_path / "paper", paper.surrogate(), None, {})
    chosen = start if model == "paper" else tmp_path / "paper"
    out = tmp_path / "s"
    words = ["--start", str(chosen), "--model", model, "--out", str(out)]
    assert f"--start {chosen}" in fails(capsys, "fit", dataset, *words)
    assert not out.exists()


def test_a_start_with_other_channels_is_refused(capsys, tmp_path, dataset, start):
    file = start / "surrogate.json"
    description = json.loads(file.read_text())
    description["channels"]["out"].append("torque_nm")
    file.write_text(json.dumps(description))
    words = ["fit", dataset, "--start", str(start), "--out", str(tmp_path / "s")]
    assert "unsupported channels" in fails(capsys, *words)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--members", "3"], "--members"),
        (["--drive.units", "4"], "--drive"),
        (["--force.wake", "1"], "--force"),
        (["--start", "nothing"], "nothing"),
    ],
)
def test_what_cannot_be_refitted_is_one_line_and_leaves_nothing(
    capsys, tmp_path, dataset, start, words, expected
):
    out = tmp_path / "s"
    line = fails(capsys, "fit", dataset, "--start", str(start), *words, "--out", str(out))
    assert expected in line
    assert not out.exists()


def test_an_unfinished_run_is_not_lost(capsys, tmp_path, dataset, monkeypatch):
    def stopped(logs, config, seed, run_directory, progress):
        run_directory.save({}, {})
        raise KeyboardInterrupt

    fit_with(monkeypatch, stopped)
    words = ["fit", dataset, "--out", str(tmp_path / "s")]
    with pytest.raises(SystemExit):
        main(words)
    assert (
        "contains an unfinished run; continue with --resume, or discard it with --overwrite"
        in fails(capsys, *words)
    )


def test_a_run_of_another_model_is_not_continued(capsys, tmp_path, dataset, monkeypatch):
    streaming = find_architecture("streaming")
    words = ["fit", dataset, "--out", str(tmp_path / "s"), "--resume"]
    monkeypatch.setattr(
        "softfin.stages.surrogates.find_architecture",
        lambda model: streaming._replace(fit=lambda *_: small.surrogate()),
    )
    run(capsys, *words, "--model", "streaming")
    assert "model was 'streaming' and is 'own:MODEL'" in fails(
        capsys, *words, "--model", "own:MODEL"
    )


@pytest.mark.parametrize("test_logs", [0, 1])
def test_the_last_lines_say_how_good_the_surrogate_is_and_what_comes_next(
    capsys, tmp_path, asked, test_logs
):
    logs = [small.recorded(300, seed) for seed in range(3)]
    write_dataset(tmp_path / "data", logs, [small.recorded(300, 9)][:test_logs], {})
    out = tmp_path / "my surrogate"
    text = run(capsys, "fit", str(tmp_path / "data"), "--out", str(out))
    *_, verdict, command = text.splitlines()
    kind = "test" if test_logs else "held-out"
    assert f"in 1 {kind} log" in verdict
    assert "% of its range" in verdict
    # Quoted for a shell.
    assert command == f"next: softfin map '{out}' --out gaits"


def test_the_clock_for_the_fin_is_proposed(capsys, tmp_path, dataset, asked, monkeypatch):
    monkeypatch.setattr("softfin.data.stroke_time.stroke_time", lambda logs: 0.12)
    out = tmp_path / "s"
    text = run(capsys, "fit", dataset, "--out", str(out))
    assert "actions of 0.12 s suit this fin and its logs: --clock auto selects 8 Hz" in text
    assert f"next: softfin map {out} --clock auto --out gaits" in text
    assert find_clock("auto", str(out)) == ActionClock.at(8, 0.75)


def test_no_clock_is_proposed_without_strokes(capsys, tmp_path, dataset, asked):
    out = tmp_path / "s"
    assert "--clock" not in run(capsys, "fit", dataset, "--out", str(out))
    with pytest.raises(ConfigurationError, match=r"stroke time of .* is unknown; use a rate"):
        find_clock("auto", str(out))
