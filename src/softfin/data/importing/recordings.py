"""Recordings of any kind, a file or a folder of them, opened as logs at 100 Hz with all that is wrong with them.

What `softfin inspect`, `softfin import-logs` and `softfin fit` share.
"""

import dataclasses
import fnmatch
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import Log
from softfin.data.checks.findings import Finding, Place, counted
from softfin.data.checks.inspection import Inspection, inspect
from softfin.data.importing.clocks import logs_of
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.recording import NamedLog, Part, Recording
from softfin.data.importing.tables import read_table
from softfin.storage import artifact as artifacts
from softfin.storage.dataset import Dataset
from softfin.storage.paths import find_recordings, is_bag

Progress = Callable[[str, float, str], None]
"""Called with what is going on, how much of it is done (0 .. 1), and a note."""


@dataclasses.dataclass(frozen=True)
class Opened:
    """Logs that can be learnt from, once `check_train` and their findings allow it."""

    logs: tuple[NamedLog, ...]
    inspection: Inspection
    data_hash: str
    """Of a dataset its own; else SHA-256 over the files and what was done to them."""
    facts: dict[str, Any]
    """For ``dataset.json``: the files, the options, the findings."""

    @property
    def train(self) -> list[Log]:
        """To learn from."""
        return [one.log for one in self.logs if one.part == "train"]

    @property
    def test(self) -> list[Log]:
        """To score on."""
        return [one.log for one in self.logs if one.part == "test"]

    @property
    def findings(self) -> list[Finding]:
        """Gravest first; `softfin.data.checks.findings.check_accepted` stops at errors."""
        return self.inspection.findings


def open_logs(path: Path, config: ImportConfig | None = None, progress: Progress | None = None) -> Opened:
    """Read and inspect everything at `path`; raises LogError or ArtifactError where it cannot be read at all."""
    config = config or ImportConfig()
    # A dataset that changed since it was written is refused before anything is read.
    dataset = Dataset.open(path) if artifacts.is_kind(path, "dataset") else None
    files = find_recordings(path)
    parts = _parts(path, files, config)
    logs: list[NamedLog] = []
    findings: list[Finding] = []
    for index, file in enumerate(files):
        for recording in _read(file, _name(file, path), parts[file], config):
            some, found = logs_of(recording, config)
            logs += some
            findings += found
        if progress is not None:
            progress("read", (index + 1) / len(files), f"{len(logs):,} logs")
    if not logs:
        raise LogError(
            f"{path}: no logs: all pieces between gaps are shorter than {config.shortest_s:g} s; "
            "--shortest 1 would keep more, --gap bridges longer gaps"
        )
    ignored = 0 if dataset else _ignored(path, files)
    if ignored:
        text = f"{counted(ignored, 'file')} not read: no CSV, Parquet or ROS 2 bag"
        findings.append(Finding("note", "other files", Place(str(path)), text))

    def report(done: int, of: int) -> None:
        if progress is not None:
            progress("inspect", done / of, f"{done:,} of {of:,} logs")

    inspection = inspect(logs, findings, config, report)
    options = config.model_dump(mode="json", exclude_defaults=True)
    data_hash = dataset.data_hash if dataset and not options else _hash(files, path, options)
    facts = {
        "imported_from": {"path": path.name, "files": [_name(file, path) for file in files], "data_hash": data_hash},
        "options": config.model_dump(mode="json"),
        "logs": [
            {"log": one.name, "part": one.part, "rows": len(one.log.reading.time), "start_s": one.start_s}
            for one in logs
        ],
        "findings": [finding.described() for finding in inspection.findings],
    }
    return Opened(tuple(logs), inspection, data_hash, facts)


def check_train(opened: Opened, source: str) -> None:
    """Raise LogError where all logs are to score on."""
    if not opened.train:
        raise LogError(f"{source}: no logs to learn from: all of its {len(opened.logs)} are to score on; see --test")


def _ignored(path: Path, files: list[Path]) -> int:
    if path.is_file():
        return 0
    taken = set(files)
    return sum(
        not entry.is_dir() and not entry.name.startswith(".") and not taken & {entry, *entry.parents}
        for entry in path.rglob("*")
    )


def _name(file: Path, path: Path) -> str:
    return file.name if file == path else file.relative_to(path).as_posix()


def _parts(path: Path, files: list[Path], config: ImportConfig) -> dict[Path, Part]:
    pattern = config.test

    def tests(name: str) -> bool:
        if pattern is not None:
            return fnmatch.fnmatch(name, pattern) or fnmatch.fnmatch(name.rsplit("/", 1)[-1], pattern)
        *folders, last = name.lower().split("/")
        return last.startswith("test") or "test" in folders

    parts: dict[Path, Part] = {file: "test" if tests(_name(file, path)) else "train" for file in files}
    if pattern is not None and "test" not in parts.values():
        names = ", ".join(_name(file, path) for file in files[:6])
        raise ConfigurationError(f"--test {pattern}: matches none of the files: {names}{' ...' * (len(files) > 6)}")
    return parts


def _read(file: Path, name: str, part: Part, config: ImportConfig) -> list[Recording]:
    if not is_bag(file):
        return read_table(file, name, part, config)
    # Whoever has no bags need not load what reads them.
    from softfin.data.importing.rosbag import read_bag

    return [read_bag(file, name, part, config)]


def _hash(files: list[Path], path: Path, options: dict[str, Any]) -> str:
    digest = hashlib.sha256(artifacts.dump_json(options).encode())
    for file in files:
        for content in sorted(file.rglob("*")) if file.is_dir() else [file]:
            if content.is_file():
                digest.update(_name(content, path).encode())
                with content.open("rb") as stream:
                    digest.update(hashlib.file_digest(stream, "sha256").digest())
    return digest.hexdigest()
