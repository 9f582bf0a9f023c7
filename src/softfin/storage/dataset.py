"""A dataset: a folder with Parquet logs (training logs in ``train/`` and test logs in ``test/``)
and a ``dataset.json``.

If you add the logs by hand, ``{}`` suffices as ``dataset.json``; `write_dataset` adds metadata.
"""

import dataclasses
import hashlib
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from softfin.core.errors import ArtifactError
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ, Log
from softfin.storage import artifact as artifacts
from softfin.storage.log_file import encode_log, read_log
from softfin.storage.paths import DATASET_PARTS, list_logs


@dataclasses.dataclass(frozen=True)
class Dataset:
    """The logs in a dataset folder. Opening the folder checks the hash of every file but reads no
    rows."""

    path: Path
    train: tuple[Path, ...]
    """Training logs; at least one."""
    test: tuple[Path, ...]
    """Test logs, which were recorded separately; may be empty."""
    description: JsonObject
    """Contents of ``dataset.json``: rate_hz, files, data_hash and the writer's metadata
    (configuration, plant, provenance)."""
    data_hash: str
    """SHA-256 over the names and contents of all logs; identifies the data to which a surrogate was
    fitted."""

    @classmethod
    def open(cls, path: Path) -> "Dataset":
        """Open a dataset; raises ArtifactError if it has no training logs or has changed since it
        was written."""
        description = artifacts.load_description(path, "dataset")
        found = _hash_files(path)
        listed = description.get("files", found)
        if not isinstance(listed, dict):
            raise ArtifactError(
                f"{path / 'dataset.json'}: 'files' must map names to hashes; remove it to disable "
                "the check"
            )
        for name in sorted(listed.keys() | found.keys()):
            if listed.get(name) != found.get(name):
                what = "truncated or changed"
                if name not in found:
                    what = "missing"
                elif name not in listed:
                    what = "new"
                raise ArtifactError(
                    f"{path / name}: {what} since dataset.json was written; copy the dataset "
                    "again, or remove 'files' from dataset.json to use the logs as they are"
                )
        train, test = map(tuple, list_logs(path))
        if not train:
            raise ArtifactError(
                f"{path}: contains no training logs; put Parquet logs into {path / 'train'}"
            )
        return cls(path, train, test, description, _hash_file(found))

    def load(self, paths: Sequence[Path]) -> Iterator[Log]:
        """Read logs one by one; raises LogError if a log cannot be used for training."""
        return map(read_log, paths)


def write_dataset(
    path: Path,
    train: Iterable[Log],
    test: Iterable[Log],
    metadata: JsonObject,
    overwrite: bool = False,
) -> Dataset:
    """Write logs one at a time as a dataset; `metadata` is added to ``dataset.json``."""

    def write(folder: Path) -> None:
        for (part, digits), logs in zip(DATASET_PARTS.items(), (train, test), strict=True):
            (folder / part).mkdir()
            for index, log in enumerate(logs):
                name = f"{part}/{index:0{digits}d}.parquet"
                (folder / name).write_bytes(encode_log(log, str(path / name)))
        hashes = _hash_files(folder)
        description = {
            "rate_hz": RATE_HZ,
            **metadata,
            "data_hash": _hash_file(hashes),
            "files": hashes,
        }
        artifacts.write_description(folder, "dataset", description)

    artifacts.write_folder(path, write, overwrite)
    return Dataset.open(path)


def _hash_files(path: Path) -> dict[str, str]:
    """Return the SHA-256 of each log, keyed by its path within the folder, in a fixed order."""
    hashes = {}
    train, test = list_logs(path)
    # The order determines the data hash, so it must not change.
    for file in (*test, *train):
        try:
            with file.open("rb") as content:
                hashes[file.relative_to(path).as_posix()] = hashlib.file_digest(
                    content, "sha256"
                ).hexdigest()
        except OSError as error:
            raise ArtifactError(
                f"{file}: cannot be read ({error.strerror}); copy it again"
            ) from None
    return hashes


def _hash_file(hashes: dict[str, str]) -> str:
    return hashlib.sha256(
        "".join(f"{name} {digest}\n" for name, digest in hashes.items()).encode()
    ).hexdigest()
