"""Keep compiled programs between runs, by JAX's persistent compilation cache, in a folder of the user's.

``SOFTFIN_CACHE`` moves the folder, or switches the cache off. A cache folder that JAX itself has been given wins.
The name of an entry is JAX's: it holds the program, the versions of JAX and XLA, the flags, and the processor with its
features.

The cache is a setting of a process, so a program's entry point switches it on, and no import does.

JAX's settings alone do not suffice, since its own store (JAX 0.10) cannot tell a damaged entry: with zstandard, which
softfin needs for recordings, an entry has no checksum. Of single flipped bits in an entry, three in four went
unnoticed, and the program that was read aborted or crashed in six of fourteen trials. Besides:

- Without a size limit, JAX writes in place. Other processes read half an entry, and what a killed process left is
  neither used nor replaced: every later run compiles it and warns.
- With a size limit, JAX needs the package filelock, waits for a lock at each reading, looks through the folder at each
  writing, and stops writing for good once a process was killed between the two files of an entry.

So entries are kept by `ProgramStore`. JAX has no public setting for the store; what is replaced is the one function by
which JAX makes it, ``get_file_cache``, and JAX's own still serves every other folder.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

from softfin.core.jax_import import when_jax_is_imported

VARIABLE = "SOFTFIN_CACHE"
OFF = "off"
JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"

LARGEST_BYTES = 2**30
"""Size that the folder may reach; the programs that were not used for longest are deleted first."""

SPARE = 16
"""Part of the size that is made free; the folder is looked through at the first entry, and after each such part."""

SHORTEST_COMPILATION_S = 0.0
"""Programs that compile faster than this are not kept: none, since an evaluation in the tank has 45 small ones beside
its large one, which take 30 ms each to compile and 6 ms to read back."""

SUFFIX = ".program"
"""Ending of the names of files, also while they are written; nothing else in the folder is counted or deleted."""

DIGEST_BYTES = hashlib.sha256().digest_size


def cache_folder() -> Path | None:
    """Folder in which compiled programs are kept; None where that is switched off, or the user has no home."""
    chosen = os.environ.get(VARIABLE, "")
    if chosen == OFF:
        return None
    given = Path(os.environ.get("XDG_CACHE_HOME", ""))
    try:
        caches = given if given.is_absolute() else Path.home() / ".cache"
        return Path(chosen).expanduser().absolute() if chosen else caches / "softfin"
    except RuntimeError:
        return None


def describe_cache() -> str:
    """Describe the cache for ``softfin --help``."""
    if given := os.environ.get(JAX_VARIABLE):
        return f"Compiled programs are kept in {given} ({JAX_VARIABLE})."
    folder = cache_folder()
    if folder is None:
        return f"Compiled programs are not kept; {VARIABLE}=FOLDER keeps them."
    return (
        f"Compiled programs are kept in {folder}, at most {LARGEST_BYTES / 2**30:g} GiB;\n"
        f"{VARIABLE}=FOLDER moves them, {VARIABLE}={OFF} keeps none."
    )


class ProgramStore:
    """Entries of JAX's cache as files with a digest, each written to a temporary file and then moved."""

    def __init__(self, folder: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        self._path, self.largest_bytes = folder, largest_bytes
        self._has_failed, self._unchecked_bytes = False, largest_bytes

    def get(self, key: str) -> bytes | None:
        """The content of an entry; none where it is missing or damaged."""
        path = self._path / f"{key}{SUFFIX}"
        try:
            data = path.read_bytes()
        except OSError:
            return None
        with contextlib.suppress(OSError):
            os.utime(path)
        digest, value = data[:DIGEST_BYTES], data[DIGEST_BYTES:]
        return value if digest == hashlib.sha256(value).digest() else None

    def put(self, key: str, value: bytes) -> None:
        """Write an entry; where that fails, say so once and go on without."""
        if DIGEST_BYTES + len(value) > self.largest_bytes:
            return
        try:
            self._path.mkdir(mode=0o700, parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(suffix=SUFFIX, dir=self._path)
            try:
                with os.fdopen(handle, "wb") as file:
                    file.write(hashlib.sha256(value).digest() + value)
                # Another process may have made room with it.
                with contextlib.suppress(FileNotFoundError):
                    Path(name).replace(self._path / f"{key}{SUFFIX}")
            finally:
                Path(name).unlink(missing_ok=True)
            self._unchecked_bytes += DIGEST_BYTES + len(value)
            if self._unchecked_bytes > self.largest_bytes // SPARE:
                self._evict(self.largest_bytes - self.largest_bytes // SPARE)
                self._unchecked_bytes = 0
        except OSError as error:
            if not self._has_failed:
                sys.stderr.write(
                    f"softfin: {self._path}: compiled programs cannot be kept ({error.strerror or error}); "
                    f"{VARIABLE}=FOLDER keeps them elsewhere, {VARIABLE}={OFF} keeps none\n"
                )
            self._has_failed = True

    def _evict(self, allowed_bytes: int) -> None:
        """Delete what was not used for longest until the rest is small enough; others may delete at the same time."""
        entries = []
        for path in self._path.glob(f"*{SUFFIX}"):
            with contextlib.suppress(FileNotFoundError):
                state = path.stat()
                entries.append((state.st_mtime_ns, state.st_size, path))
        size = sum(size for _, size, _ in entries)
        for _, bytes_, path in sorted(entries):
            if size <= allowed_bytes:
                break
            path.unlink(missing_ok=True)
            size -= bytes_


def use_program_cache() -> None:
    """Switch the cache on in this process, unless the user has switched it off or given JAX a folder.

    For the entry points of programs. JAX is not imported for it: the cache is there as soon as JAX is.
    """
    when_jax_is_imported(_switch_on)


def _switch_on() -> None:
    import jax

    folder, config = cache_folder(), cast(Any, jax.config)
    if folder is None or config.jax_compilation_cache_dir is not None:
        return
    try:
        from jax._src import compilation_cache

        jax_store = compilation_cache.get_file_cache
    except (ImportError, AttributeError):
        # A JAX that chooses its store elsewhere: no cache is better than one that breaks.
        return

    def choose_store(path: str) -> Any:
        return (ProgramStore(folder), path) if path == str(folder) else jax_store(path)

    compilation_cache.get_file_cache = choose_store
    config.update("jax_compilation_cache_dir", str(folder))
    # On a GPU, XLA would write files of its own beside them, that nobody counts or deletes.
    config.update("jax_persistent_cache_enable_xla_caches", "none")
    if config.jax_persistent_cache_min_compile_time_secs == 1.0:
        # JAX's default; another value is the user's.
        config.update("jax_persistent_cache_min_compile_time_secs", SHORTEST_COMPILATION_S)
