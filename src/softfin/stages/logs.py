"""Check recordings and import them as a dataset. No JAX."""

from pathlib import Path

from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress, silent
from softfin.data.checks.inspection import Inspection
from softfin.data.checks.report import write_inspection
from softfin.data.importing.importing import ImportConfig
from softfin.data.recordings import open_logs
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset, write_dataset


def inspect_logs(
    path: Path,
    out: Path | None = None,
    config: ImportConfig | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> JsonObject:
    """Check recordings for issues; writes ``inspection.json`` and a figure to `out`."""
    if out is not None:
        artifacts.check_vacant(out, overwrite)
    config = config or ImportConfig()
    opened = open_logs(path, config, progress)
    metadata = {
        "source": str(path),
        "options": config.model_dump(mode="json"),
        "provenance": artifacts.provenance(data_hash=opened.data_hash),
    }
    if out is None:
        return {**opened.inspection.to_dict(), **metadata}
    return write_inspection(opened.inspection, opened.logs, out, metadata, overwrite)


def import_logs(
    path: Path,
    out: Path,
    config: ImportConfig | None = None,
    *,
    ignore_errors: bool = False,
    overwrite: bool = False,
    progress: Progress = silent,
) -> tuple[Dataset, Inspection]:
    """Convert recordings of any kind to a dataset; raises LogError if they have errors and
    `ignore_errors` is not set."""
    artifacts.check_vacant(out, overwrite)
    opened = open_logs(path, config or ImportConfig(), progress)
    opened.check_train(str(path))
    opened.check_issues(str(path), ignore_errors)
    metadata = {
        **opened.metadata,
        "ignore_errors": ignore_errors,
        "provenance": artifacts.provenance(),
    }
    return write_dataset(out, opened.train, opened.test, metadata, overwrite), opened.inspection
