"""Stages that fit models of a fin: surrogates (paper Sec. III-B) and the calibrated tank."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.core.choices import CalibratePreset
from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.option_types import (
    DATA,
    DIR,
    HIDDEN,
    LOGS,
    RECORDINGS,
    Config,
    PathLike,
    PlantLike,
)
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.core.seeds import check_seed
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import counted
from softfin.stages.logs import columns_read
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.paths import find_recordings, typed_path
from softfin.storage.registry import check_data, plant_name
from softfin.surrogate.registry import DEFAULT, find_architecture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from softfin.core.plant import Plant
    from softfin.core.quantities import Log
    from softfin.data.recordings import OpenedLogs
    from softfin.surrogate.protocol import SurrogatePlant
    from softfin.surrogate.streaming.refit import Refit

SHOWN_TEST_S = 8
"""Length of the test log segment in the figure [s]."""


@lock_output
def fit(
    dataset: Annotated[PathLike, LOGS],
    *,
    out: Annotated[PathLike, DIR],
    model: str = DEFAULT,
    start: Annotated[PathLike | None, DIR] = None,
    recordings: Annotated[ImportConfig | None, RECORDINGS] = None,
    seed: int = 0,
    config: Config = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Fit a surrogate to logs and print its scores (paper Sec. III-B, Table I).

    Args:
        dataset: Folder of a dataset, or of CSV files, Parquet files or ROS 2 bags.
        out: Surrogate folder to write.
        model: streaming (an ensemble), paper (PosNet and ForceNet) or package.module:NAME.
        start: Streaming surrogate to refit to new logs of its fin, after the fin has changed.
        recordings: How to read recordings from other programs.
        seed: Seed for weights, shuffling and dropout.
        config: Configuration of the model; its fields are options too, such as --members 3.
        resume: Continue from the last checkpoint of an unfinished run.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        Table I, issue counts, stroke time, a caveat, and a warning if noise hides the force.

    Raises:
        LogError: If the logs have errors that were ignored neither now nor at import.

    Example:
        >>> softfin.fit("dataset", out="surrogate", config={"members": 3})
    """
    dataset = Path(dataset)
    out = Path(out)
    check_seed(seed)
    find_recordings(dataset)
    artifacts.check_vacant(out, overwrite or resume, kind="surrogate")
    refit = None if start is None else _load_refit(Path(start), model)
    architecture = refit or find_architecture(model)
    settings = configure(architecture.config(), config)
    from softfin.data.recordings import open_logs
    from softfin.data.stroke_time import stroke_time
    from softfin.storage.figures import save_figure
    from softfin.storage.run_directory import RunDirectory
    from softfin.surrogate import StreamingSurrogate, save_surrogate
    from softfin.surrogate.channels import SKIPPED, ranges
    from softfin.surrogate.table_one import measured_ranges, table_one
    from softfin.surrogate.training import check_lengths, hold_out

    is_dataset = artifacts.is_kind(dataset, "dataset")
    description = artifacts.load_description(dataset, "dataset") if is_dataset else {}
    opened = open_logs(dataset, recordings, progress)
    opened.check_train(str(dataset))
    opened.check_issues(str(dataset))
    _check_commands(dataset, opened.train)
    # Checked before the long fit, so that scoring cannot fail afterwards.
    scored = opened.test or list(hold_out(opened.train, settings.held_out)[1])
    part = "test" if opened.test else "held-out"
    check_lengths(scored, SKIPPED, part)
    measured_ranges(scored)
    metadata: JsonObject = {
        "configuration": settings.model_dump(mode="json"),
        "seed": seed,
        "data_hash": opened.data_hash,
        "model": model,
    }
    # The metadata of a dataset are already in the dataset folder.
    own: JsonObject = {} if description else {"logs": opened.metadata}
    entries: JsonObject = {"stroke_s": stroke_time(opened.train), "fin": description.get("fin")}
    if refit:
        own["refit"] = refit.provenance(opened.train, scored)
        metadata["start"] = own["refit"]["identity"]
        entries |= refit.entries
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        fitted = architecture.fit(opened.train, settings, seed, run_directory, progress)

        def keep(folder: Path) -> None:
            run_directory.keep_log(folder)
            if scored[0].rows > fitted.memory:
                save_figure(_predict_test(fitted, scored[0]), folder / "prediction.png")

        power = fitted.power_scores(scored) if isinstance(fitted, StreamingSurrogate) else None
        provenance = artifacts.provenance(
            seed=seed, data_hash=opened.data_hash, dataset=str(dataset), **own
        )
        save_surrogate(
            out,
            fitted,
            table_one(fitted, scored),
            provenance,
            extra_files=keep,
            overwrite=overwrite,
            configuration=metadata["configuration"],
            training_range=ranges(opened.train),
            power=power,
            **entries,
        )
    run_directory.finish()
    return _summarize_fit(dataset, out, opened, counted(len(scored), f"{part} log"))


def _load_refit(path: Path, model: str) -> "Refit":
    """Load the surrogate to refit; raises ConfigurationError if it is not a streaming surrogate."""
    from softfin.surrogate import StreamingSurrogate, load_surrogate
    from softfin.surrogate.streaming.refit import Refit

    start = load_surrogate(path)
    if not isinstance(start, StreamingSurrogate) or start.model != model:
        raise ConfigurationError(
            f"--start {path}: a {start.model} surrogate cannot be refitted with --model {model}; "
            "use streaming for both, or fit without --start"
        )
    description = artifacts.load_description(path, "surrogate")
    entries = {name: description[name] for name in ("stroke_s", "fin") if description.get(name)}
    return Refit(str(path), start, entries)


def _summarize_fit(dataset: Path, out: Path, opened: "OpenedLogs", scored: str) -> Result:
    from softfin.core.action_clock import PAPER_CLOCK, ActionClock
    from softfin.core.plant import EnsemblePlant
    from softfin.stages.tables import format_table_one
    from softfin.surrogate import load_surrogate

    written = artifacts.load_description(out, "surrogate")
    surrogate = load_surrogate(out)
    summary = opened.inspection.summary()
    stroke_s = written.get("stroke_s")
    caveat = surrogate.interval.caveat() if isinstance(surrogate, EnsemblePlant) else None
    warning = _noise_warning(out, surrogate, opened.train)
    parts = [format_table_one(written["scores"])]
    if (power := written.get("power")) is not None:
        parts.append(_describe_power(power))
    if caveat is not None:
        parts.append(f"note: {caveat}")
    refit = written["provenance"].get("refit")
    if refit:
        better = refit["start"] if refit["scores"] == written["scores"] else "the refit"
        parts.append(f"{refit['start']}: {_verdict(refit['scores'], scored)}; {better} is kept")
    clock = ""
    if stroke_s is not None and (fitting := ActionClock.for_strokes(stroke_s)) != PAPER_CLOCK:
        parts.append(
            f"actions of {stroke_s:.2g} s suit this fin and its logs: --clock auto selects "
            f"{fitting}"
        )
        clock = " --clock auto"
    parts.append(
        f"{out}: {_verdict(written['scores'], scored)}\n"
        f"next: softfin map {typed_path(out)}{clock} --out gaits"
    )
    notes = columns_read(summary["columns"]) + issue_line(summary["counts"], dataset)
    if warning is not None:
        notes += f"warning: {warning}\n"
    values = {
        "surrogate": str(out),
        "model": surrogate.model,
        "table_i": written["scores"],
        "power": power,
        "issues": summary["counts"],
        "columns": summary["columns"],
        "stroke_s": stroke_s,
        "caveat": caveat,
        "warning": warning,
        "refit": refit,
    }
    return Result(values, notes + "\n\n".join(parts))


def _verdict(table: JsonObject, scored: str) -> str:
    """Return the error of the predicted force, also as a percentage of its range."""
    # The last force predictor is the complete surrogate.
    *_, force = (row for row in table.values() if row["unit"] == "N")
    return (
        f"error of the predicted force {force['physical']['rmse']:.2g} N (RMS) in {scored}, "
        f"{100 * force['scaled']['rmse']:.2g}% of its range"
    )


def _describe_power(power: JsonObject) -> str:
    return (
        f"error of the predicted mean power {power['rmse_w']:.2g} W (RMS over 2 s) in "
        f"{counted(power['logs'], 'log')}, {100 * power['rmse_w'] / power['mean_w']:.2g}% of its "
        f"mean; {100 * power['coverage']:.0f}% of the means are inside their intervals"
    )


def issue_line(counts: Mapping[str, int], dataset: Path) -> str:
    """Return one line with the issue counts of the training logs; empty if there are no issues."""
    if not counts["error"] + counts["warning"]:
        return ""
    found = ", ".join(counted(count, kind) for kind, count in counts.items() if count)
    return f"{dataset}: {found}; run softfin inspect {dataset} to list them\n"


def _predict_test(surrogate: "SurrogatePlant", log: "Log") -> "Figure":
    """Draw the force in a segment of a test log and the predictions of the surrogate."""
    import numpy as np

    from softfin.core.quantities import RATE_HZ
    from softfin.evaluation.report import prediction_figure
    from softfin.surrogate.channels import FORCES

    # Start late enough to fill the memory of the surrogate.
    first = max(surrogate.memory, min(10 * RATE_HZ, log.rows // 2))
    measured = np.asarray(log.reading.force[first:][: SHOWN_TEST_S * RATE_HZ])
    predicted = {}
    for network in surrogate.predictions([log]).values():
        if network.channels == FORCES:
            # The first rows of the log have no prediction.
            predicted[network.title] = network.series[0][first - log.rows :][: len(measured)]
    return prediction_figure(measured, predicted, first / RATE_HZ)


def _noise_warning(out: Path, surrogate: "Plant", logs: "Sequence[Log]") -> str | None:
    """Return a warning if the noise of the mean force hides the force in the logs; None otherwise,
    or if the noise is unknown."""
    import numpy as np

    from softfin.core.plant import NoisyPlant
    from softfin.core.window import window_means

    if not isinstance(surrogate, NoisyPlant):
        return None
    noise_n = surrogate.mean_force_noise_n
    means = np.concatenate([window_means(np.asarray(log.reading.force)) for log in logs])
    if not means.size:
        return None
    # Use the axis with the larger force, because fins may produce much more force along one axis.
    measured_n = float(np.sqrt(np.mean(means**2, axis=0)).max())
    # The measured mean square is the sum of the mean squares of force and noise.
    if measured_n**2 >= 2 * noise_n**2:
        return None
    return (
        f"{out}: noise hides the force: the mean force over 2 s in the logs is {measured_n:.2g} N "
        f"rms, but this includes noise of {noise_n:.2g} N (including drift and the fitting error); "
        "use a more sensitive force sensor or faster strokes, record more logs, or fit longer"
    )


def _check_commands(dataset: Path, train: "Sequence[Log]") -> None:
    """Raise LogError if the range of the training commands is implausible for a fin."""
    from softfin.core.quantities import MAX_ANGLE_RAD, command_limits

    limits = command_limits(train)
    if problem := limits.problem():
        largest = max(abs(limits.angle_min), abs(limits.angle_max))
        hint = "; if they are in degrees, use --angles deg" if largest > MAX_ANGLE_RAD else ""
        raise LogError(f"{dataset}: the training commands: {problem}{hint}")


@lock_output
def calibrate(
    data: Annotated[PathLike | PlantLike, DATA],
    *,
    out: Annotated[PathLike, DIR],
    preset: CalibratePreset = "full",
    seed: int = 0,
    config: Config = None,
    resume: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Fit the virtual tank to logs or to a plant, and report how well each parameter is
    determined.

    Args:
        data: Logs, or a plant: tank, a tank YAML file, a surrogate or package.module:plant.
        out: Output folder for calibration.json and tank.yaml.
        preset: full: fin, water, drive and recording; quick: six parameters, about a minute.
        seed: Seed for the search and the commands.
        config: `CalibrateConfig`; its fields are options too, such as --evaluations 0.
        resume: Continue a stopped run.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        The contents of calibration.json.

    Example:
        >>> softfin.calibrate("dataset", out="calibration", preset="quick")
    """
    out = Path(out)
    check_seed(seed)
    artifacts.check_vacant(out, overwrite or resume, kind="calibration")
    check_data(data)
    from softfin.storage.run_directory import RunDirectory
    from softfin.tank.calibration.calibrate import calibrate_tank
    from softfin.tank.calibration.config import CALIBRATE_PRESETS
    from softfin.tank.calibration.model import material

    settings = configure(CALIBRATE_PRESETS[preset], config)
    train, test, source = material(data, settings, seed)
    metadata = {"configuration": settings.model_dump(mode="json"), "seed": seed, **source}
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        calibration = calibrate_tank(settings, train, test, seed, run_directory, progress)
        origin = artifacts.provenance(seed=seed, data=plant_name(data), **source)
        written = {"configuration": metadata["configuration"], "provenance": origin}
        calibration.write(out, written, run_directory.keep_log, overwrite)
    run_directory.finish()
    summary = artifacts.load_description(out, "calibration")
    return Result({"calibration": str(out), **summary}, calibration_tables(summary))


def calibration_tables(result: JsonObject) -> str:
    """Return the scores, then the parameters."""
    from softfin.stages.tables import aligned

    scores = [["R2 (RMSE)", "angle", "force x", "force y"]]
    for part, title in (("train", "fitted segments"), ("test", "unseen segments")):
        rows = zip(result["scores"][part].values(), ("rad", "N", "N"), strict=True)
        scores.append(
            [title, *(f"{row['r2']:.3f} ({row['rmse']:.2g} {unit})" for row, unit in rows)]
        )
    parameters = [["parameter", "value", "error", "unit", "determined"]]
    for name, row in result["parameters"].items():
        error = "" if row["standard_error"] is None else f"{row['standard_error']:.2g}"
        parameters.append([name, f"{row['value']:.4g}", error, row["unit"], row["determined"]])
    return "\n".join([*aligned(scores), "", *aligned(parameters, (0, 3))])
