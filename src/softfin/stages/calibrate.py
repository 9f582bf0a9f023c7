"""Fit the virtual tank to logs or to another plant."""

from pathlib import Path
from typing import Any

from softfin.core.plant import Plant
from softfin.core.progress import Progress
from softfin.storage import artifact as artifacts
from softfin.storage.run_directory import RunDirectory
from softfin.tank.calibration.calibrate import calibrate as _calibrate
from softfin.tank.calibration.config import CalibrateConfig
from softfin.tank.calibration.model import material


def calibrate(
    data: str | Path | Plant,
    out: Path,
    config: CalibrateConfig | None = None,
    *,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit the virtual tank to a dataset or to a plant; writes ``calibration.json``, ``tank.yaml`` and figures."""
    config = config or CalibrateConfig()
    artifacts.check_vacant(out, overwrite or resume)
    train, test, source = material(data, config, seed)
    metadata = {"configuration": config.model_dump(mode="json"), "seed": seed, **source}
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if run_directory.complete:
        run_directory.finish()
        return artifacts.load_description(out, "calibration")
    calibration = _calibrate(config, train, test, seed, run_directory, progress)
    named = str(data) if isinstance(data, str | Path) else type(data).__name__
    origin = artifacts.provenance(seed=seed, data=named, **source)
    written = {"configuration": metadata["configuration"], "provenance": origin}
    summary = calibration.write(out, written, run_directory.keep_log, overwrite)
    run_directory.finish()
    return summary
