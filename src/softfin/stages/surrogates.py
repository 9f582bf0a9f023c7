"""Stages for models of a fin: fit a surrogate (paper Sec. III-B), and calibrate the tank."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.json_object import JsonObject
from softfin.core.plant import EnsemblePlant, NoisyPlant, Plant
from softfin.core.progress import Progress, silent
from softfin.core.quantities import MAX_ANGLE_RAD, Log, command_limits
from softfin.core.window import window_means
from softfin.data.importing.importing import ImportConfig
from softfin.data.recordings import open_logs
from softfin.data.stroke_time import stroke_time
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import plant_name
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import SurrogateConfig, load_surrogate, save_surrogate
from softfin.surrogate.channels import SKIPPED, ranges
from softfin.surrogate.registry import DEFAULT, find_architecture
from softfin.surrogate.table_one import measured_ranges, table_one
from softfin.surrogate.training import check_lengths
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.model import material


@lock_output
def fit(
    dataset: Path,
    out: Path,
    config: SurrogateConfig | None = None,
    *,
    logs: ImportConfig | None = None,
    ignore_errors: bool = False,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Fit a surrogate to logs, score it on the test logs, and write it; returns Table I, issue
    counts, a caveat, and a warning if noise hides the force in the logs.

    The class of the configuration selects the architecture: `StreamingConfig` (the default),
    `FitConfig` for the paper's networks, or that of your own architecture.
    `dataset` is a dataset's folder, or recordings of any other kind, read with the options in
    `logs`. Raises LogError if the logs have errors, unless errors are ignored, now or when the
    dataset was imported.
    """
    config = config or find_architecture(DEFAULT).config()
    architecture = find_architecture(config.model)
    if type(config) is not architecture.config:
        raise ConfigurationError(
            f"{type(config).__name__}: its model {config.model} has a different configuration; set "
            "the default of model to the package.module:NAME of your own architecture"
        )
    artifacts.check_vacant(out, overwrite or resume)
    description = (
        artifacts.load_description(dataset, "dataset")
        if artifacts.is_kind(dataset, "dataset")
        else {}
    )
    opened = open_logs(dataset, logs, progress)
    opened.check_train(str(dataset))
    were_ignored = description.get("ignore_errors") is True
    opened.check_issues(str(dataset), ignore_errors or were_ignored)
    metadata = {
        "configuration": config.model_dump(mode="json"),
        "seed": seed,
        "data_hash": opened.data_hash,
    }
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        _check_commands(dataset, opened.train)
        # Check the test logs before the long fit, so that scoring cannot fail afterwards.
        test = opened.test
        check_lengths(test, SKIPPED, "test")
        if test:
            measured_ranges(test)
        fitted = architecture.fit(opened.train, config, seed, run_directory, progress)
        # The metadata of a dataset are already in its own folder.
        own = {} if description else {"logs": opened.metadata}
        provenance = artifacts.provenance(
            seed=seed, data_hash=opened.data_hash, dataset=str(dataset), **own
        )
        save_surrogate(
            out,
            fitted,
            table_one(fitted, test) if test else None,
            provenance,
            extra_files=run_directory.keep_log,
            overwrite=overwrite,
            configuration=metadata["configuration"],
            training_range=ranges(opened.train),
            stroke_s=stroke_time(opened.train),
            fin=description.get("fin"),
        )
    run_directory.finish()
    written = artifacts.load_description(out, "surrogate")
    surrogate = load_surrogate(out)
    summary = opened.inspection.summary()
    return {
        "model": surrogate.model,
        "table_i": written["scores"],
        "issues": summary["counts"],
        "columns": summary["columns"],
        "stroke_s": written.get("stroke_s"),
        "caveat": surrogate.interval.caveat() if isinstance(surrogate, EnsemblePlant) else None,
        "warning": _noise_warning(out, surrogate, opened.train),
    }


def _noise_warning(out: Path, surrogate: Plant, logs: Sequence[Log]) -> str | None:
    """Return a warning if the noise of the mean force hides the force in the logs; None if it does
    not, or if it is unknown."""
    if not isinstance(surrogate, NoisyPlant):
        return None
    noise_n = surrogate.mean_force_noise_n
    means = np.concatenate([window_means(np.asarray(log.reading.force)) for log in logs])
    if not means.size:
        return None
    # The larger axis: fins may produce much more force along one of them.
    measured_n = float(np.sqrt(np.mean(means**2, axis=0)).max())
    # The measured mean square is that of the force plus that of the noise.
    if measured_n**2 >= 2 * noise_n**2:
        return None
    return (
        f"{out}: noise hides the force: the mean force over 2 s in the logs is {measured_n:.2g} N "
        f"rms, but this includes noise of {noise_n:.2g} N (with drift and the error of the fit); "
        "use a more sensitive force sensor or faster strokes, record more logs, or fit longer"
    )


def _check_commands(dataset: Path, train: Sequence[Log]) -> None:
    """Raise LogError if no fin can have the training commands' range."""
    limits = command_limits(train)
    if problem := limits.problem(one_velocity=True):
        largest = max(abs(limits.angle_min), abs(limits.angle_max))
        hint = "; if they are in degrees, use --angles deg" if largest > MAX_ANGLE_RAD else ""
        raise LogError(f"{dataset}: the training commands: {problem}{hint}")


@lock_output
def calibrate(
    data: str | Path | Plant,
    out: Path,
    config: CalibrateConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Fit the virtual tank to a dataset or to a plant; writes ``calibration.json``, ``tank.yaml``
    and figures."""
    config = config or CalibrateConfig()
    artifacts.check_vacant(out, overwrite or resume)
    train, test, source = material(data, config, seed)
    metadata = {"configuration": config.model_dump(mode="json"), "seed": seed, **source}
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if run_directory.complete:
        run_directory.finish()
        return artifacts.load_description(out, "calibration")
    # Matplotlib, which takes a second, is only imported to draw.
    from softfin.tank.calibration.calibrate import calibrate_tank

    calibration = calibrate_tank(config, train, test, seed, run_directory, progress)
    origin = artifacts.provenance(seed=seed, data=plant_name(data), **source)
    written = {"configuration": metadata["configuration"], "provenance": origin}
    summary = calibration.write(out, written, run_directory.keep_log, overwrite)
    run_directory.finish()
    return summary
