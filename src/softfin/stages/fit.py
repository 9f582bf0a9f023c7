"""Fit a surrogate to logs, or import a published one (paper Sec. III-B)."""

import dataclasses
from pathlib import Path
from typing import Any

from softfin.core.errors import LogError
from softfin.core.plant import EnsemblePlant
from softfin.core.progress import Progress
from softfin.data.importing.importing import ImportConfig
from softfin.data.recordings import OpenedLogs, open_logs
from softfin.storage import artifact as artifacts
from softfin.storage.run_directory import RunDirectory
from softfin.surrogate import (
    AutoConfig,
    FitConfig,
    StreamingConfig,
    Surrogate,
    load_surrogate,
    save_surrogate,
)
from softfin.surrogate import import_keras as _import_keras
from softfin.surrogate.channels import SKIPPED, command_limits, ranges
from softfin.surrogate.compare.scores import measured_ranges, table_one
from softfin.surrogate.selection import fit_any
from softfin.surrogate.training import check_lengths


def fit(
    dataset: Path,
    out: Path,
    config: FitConfig | StreamingConfig | AutoConfig | None = None,
    *,
    logs: ImportConfig | None = None,
    ignore_errors: bool = False,
    seed: int = 0,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Fit a surrogate to logs, score it on their test logs, write it; returns Table I, counts of issues, a caveat.

    The kind of configuration says which model: the paper's nets, streaming nets, or what is best on held-out logs.
    `dataset` is a dataset's folder, or recordings of any other kind, read as `logs` says; raises LogError where these
    have errors, unless these are ignored, now or when the dataset was imported.
    """
    config = config or StreamingConfig()
    artifacts.check_vacant(out, overwrite or resume)
    opened = _opened(dataset, logs, ignore_errors, progress)
    metadata = {"configuration": config.model_dump(mode="json"), "seed": seed, "data_hash": opened.data_hash}
    run_directory = RunDirectory(out, metadata, resume, overwrite)
    if not run_directory.complete:
        if problem := command_limits(opened.train).problem(one_velocity=True):
            raise LogError(f"{dataset}: the commands to learn from: {problem}; are they in degrees? see --angles deg")
        test = opened.test
        check_lengths(test, SKIPPED, "test")
        if test:
            measured_ranges(test)
        fitted, evidence = fit_any(opened.train, config, seed, run_directory, progress)
        provenance = artifacts.provenance(
            seed=seed, data_hash=opened.data_hash, dataset=str(dataset), **opened.metadata
        )
        save_surrogate(
            out, fitted, table_one(fitted, test) if test else None, provenance,
            extra_files=run_directory.keep_log, overwrite=overwrite, configuration=metadata["configuration"],
            training_range=ranges(opened.train), fin=_fin_of(dataset),
            **({} if evidence is None else {"candidates": evidence}),
        )  # fmt: skip
    run_directory.finish()
    description, surrogate = artifacts.load_description(out, "surrogate"), load_surrogate(out)
    summary = opened.inspection.summary()
    return {
        "model": surrogate.model,
        "table_i": description["scores"],
        "candidates": description.get("candidates"),
        "issues": summary["counts"],
        "columns": summary["columns"],
        "caveat": surrogate.interval.caveat() if isinstance(surrogate, EnsemblePlant) else None,
    }


def _opened(dataset: Path, config: ImportConfig | None, ignore_errors: bool, progress: Progress | None) -> OpenedLogs:
    opened = open_logs(dataset, config, progress)
    opened.check_train(str(dataset))
    description = artifacts.load_description(dataset, "dataset") if artifacts.is_kind(dataset, "dataset") else None
    # Datasets of softfin before 0.2 have "accepted" in place of "ignore_errors".
    were_ignored = description is not None and True in (description.get("ignore_errors"), description.get("accepted"))
    opened.check_issues(str(dataset), ignore_errors or were_ignored)
    # A dataset's own folder has its metadata.
    return dataclasses.replace(opened, metadata={"logs": opened.metadata} if description is None else {})


def _fin_of(dataset: Path) -> str | None:
    """The name that a rig gave to its fin, where a dataset was recorded on one."""
    if not artifacts.is_kind(dataset, "dataset"):
        return None
    fin = artifacts.load_description(dataset, "dataset").get("fin")
    return None if fin is None else str(fin)


def import_keras(posnet: Path, forcenet: Path, scalers: Path, out: Path, *, overwrite: bool = False) -> Surrogate:
    """Two published ``.keras`` files and the JSON of their scalers become a surrogate."""
    artifacts.check_vacant(out, overwrite)
    surrogate = _import_keras(posnet, forcenet, scalers)
    sources = {"posnet": posnet.name, "forcenet": forcenet.name, "scalers": scalers.name}
    save_surrogate(out, surrogate, None, artifacts.provenance(imported_from=sources), overwrite=overwrite)
    return surrogate
