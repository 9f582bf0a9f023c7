"""Opens a recording of any kind, or a folder of recordings, as inspected logs at 100 Hz.

`softfin inspect`, `softfin import-logs` and `softfin fit` share this module.
"""

import dataclasses
import fnmatch
import hashlib
from collections.abc import Iterable
from pathlib import Path

import pyarrow as pa

from softfin.core.configuration import read_yaml
from softfin.core.errors import ConfigurationError, LogError, NotALogError
from softfin.core.json_object import JsonObject
from softfin.core.progress import Progress
from softfin.core.quantities import Log
from softfin.data.checks.inspection import Inspection, inspect
from softfin.data.importing.clocks import NamedLog, Part, build_logs
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.tables import read_table
from softfin.data.issues import Issue, counted
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.paths import find_recordings, is_bag


@dataclasses.dataclass(frozen=True)
class OpenedLogs:
    """Logs at 100 Hz with their inspection; `check_train` and `check_issues` reject unusable
    logs."""

    logs: tuple[NamedLog, ...]
    inspection: Inspection
    data_hash: str
    """Hash of the dataset, or SHA-256 of the files and import options of other recordings."""
    metadata: JsonObject
    """Files, options and issues, to be written to ``dataset.json``."""
    config: ImportConfig = dataclasses.field(default_factory=ImportConfig)
    """Options with which the logs were read: given options, and options saved next to the logs."""

    @property
    def train(self) -> list[Log]:
        """Training logs."""
        return [one.log for one in self.logs if one.part == "train"]

    @property
    def test(self) -> list[Log]:
        """Test logs."""
        return [one.log for one in self.logs if one.part == "test"]

    def check_train(self, source: str) -> None:
        """Raise LogError if all logs are test logs."""
        if not self.train:
            raise LogError(
                f"{source}: no training logs, only {counted(len(self.logs), 'test log')}; change "
                "--test PATTERN, which selects the test logs"
            )

    def check_issues(self, source: str) -> None:
        """Raise LogError with the first error that is not ignored by name, and the number of
        further errors."""
        errors = self.remaining_errors()
        if not errors:
            return
        text = f"{errors[0].place}: {errors[0].message}"
        if errors[0].fix:
            text += f"; {errors[0].fix}"
        if len(errors) > 1:
            text += f"; {counted(len(errors) - 1, 'more error')} (softfin inspect lists all)"
        raise LogError(f"{source}: {text}; use {ignoring(errors)} to use these logs anyway")

    def remaining_errors(self) -> list[Issue]:
        """Return the errors that are not ignored by name."""
        names = {name.replace("-", " ") for name in self.config.ignore_errors}
        errors = [issue for issue in self.inspection.issues if issue.severity == "error"]
        return [] if "all" in names else [issue for issue in errors if issue.name not in names]


def ignoring(errors: Iterable[Issue]) -> str:
    """Return the command-line option that ignores these errors."""
    names = dict.fromkeys(issue.name.replace(" ", "-") for issue in errors)
    return f"--ignore-errors {','.join(names)}"


def options_file(path: Path) -> Path:
    """Return the file with the import options of the recordings at `path`, which need not exist."""
    folder = path if path.is_dir() and not is_bag(path) else path.parent
    return folder / "log.yaml"


def _saved_options(path: Path, given: ImportConfig | None, dataset: Dataset | None) -> ImportConfig:
    """Return the options saved next to the recordings, overridden by the given options. Errors that
    were ignored when a dataset was imported remain ignored."""
    saved = ImportConfig()
    file = options_file(path)
    if dataset is not None:
        imported = dataset.description.get("options", {})
        saved = ImportConfig(ignore_errors=imported.get("ignore_errors", ()))
    if file.is_file():
        saved = saved.merged(read_yaml(file), str(file))
    return saved.merged(given.model_dump(exclude_unset=True), "options") if given else saved


def open_logs(
    path: Path, config: ImportConfig | None = None, progress: Progress | None = None
) -> OpenedLogs:
    """Read and inspect all recordings at `path`; raises LogError or ArtifactError if they cannot be
    read."""
    # Before reading, reject a dataset that was modified after it was written.
    dataset = Dataset.open(path) if artifacts.is_kind(path, "dataset") else None
    config = _saved_options(path, config, dataset)
    files = {file: _name(file, path) for file in find_recordings(path)}
    parts = _parts(list(files.values()), config.test)
    logs: list[NamedLog] = []
    issues: list[Issue] = []
    refusals: list[LogError] = []
    for index, (file, name) in enumerate(files.items()):
        try:
            some, found = _read(file, name, parts[name], config)
        except LogError as error:
            # One file that is not a log does not make the other files unusable.
            refusals.append(error)
            found = [_refusal(error, name)]
        else:
            logs += some
        issues += found
        if progress is not None and logs:
            progress("read", (index + 1) / len(files), f"{len(logs):,} logs")
    if not logs and refusals:
        others = f"; {counted(len(refusals) - 1, 'more file')} refused" if refusals[1:] else ""
        raise LogError(f"{refusals[0]}{others}")
    if not logs:
        raise LogError(
            f"{path}: no logs: all pieces between gaps are shorter than {config.shortest_s:g} s; "
            "use --shortest 1 to keep shorter pieces, or --gap SECONDS to bridge longer gaps"
        )
    inspection = inspect(logs, issues, config, progress)
    present = {"all", *(issue.name.replace(" ", "-") for issue in inspection.issues)}
    if absent := [name for name in config.ignore_errors if name.replace(" ", "-") not in present]:
        text = f"--ignore-errors {','.join(absent)}: these logs have no such issue"
        inspection.issues.append(Issue("note", "nothing to ignore", "all logs", text))
    options = config.model_dump(mode="json", exclude_defaults=True, exclude={"ignore_errors"})
    data_hash = dataset.data_hash if dataset and not options else _hash(files, path, options)
    metadata = {
        "imported_from": {"path": path.name, "files": list(files.values()), "data_hash": data_hash},
        "options": config.model_dump(mode="json"),
        "logs": [
            {"log": one.name, "part": one.part, "rows": one.log.rows, "start_s": one.start_s}
            for one in logs
        ],
        "issues": [dataclasses.asdict(issue) for issue in inspection.issues],
    }
    return OpenedLogs(tuple(logs), inspection, data_hash, metadata, config)


def _read(
    file: Path, name: str, part: Part, config: ImportConfig
) -> tuple[list[NamedLog], list[Issue]]:
    """Read the logs in a file; also return the issues found while reading."""
    if is_bag(file):
        # Imported late: the bag reader is only loaded if there are bags.
        from softfin.data.importing.rosbag import read_bag

        recordings = [read_bag(file, name, part, config)]
    else:
        recordings = read_table(file, name, part, config)
        # The text of the columns, for which Arrow would keep the memory.
        pa.default_memory_pool().release_unused()
    logs: list[NamedLog] = []
    issues: list[Issue] = []
    for recording in recordings:
        some, found = build_logs(recording, config)
        logs += some
        issues += found
    return logs, issues


def _refusal(error: LogError, name: str) -> Issue:
    """Return the issue for an unreadable file: an error, or a warning if the file is not a log."""
    if isinstance(error, NotALogError):
        return Issue("warning", "not a log", name, f"ignored ({error})")
    return Issue("error", "unreadable", name, str(error))


def _parts(names: list[str], pattern: str | None) -> dict[str, Part]:
    """Assign each file to training or test, by the pattern or by whether its name starts with
    test."""
    parts: dict[str, Part] = {}
    for name in names:
        *folders, last = name.split("/")
        if pattern is not None:
            is_test = fnmatch.fnmatch(name, pattern) or fnmatch.fnmatch(last, pattern)
        else:
            is_test = last.lower().startswith("test") or "test" in map(str.lower, folders)
        parts[name] = "test" if is_test else "train"
    if pattern is not None and "test" not in parts.values():
        raise ConfigurationError(
            f"--test {pattern}: matches none of these files: {', '.join(names[:6])}"
        )
    return parts


def _name(file: Path, path: Path) -> str:
    return file.name if file == path else file.relative_to(path).as_posix()


def _hash(files: Iterable[Path], path: Path, options: JsonObject) -> str:
    digest = hashlib.sha256(artifacts.dump_json(options).encode())
    for file in files:
        for content in sorted(file.rglob("*")) if file.is_dir() else [file]:
            if content.is_file():
                digest.update(_name(content, path).encode())
                with content.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
