"""Settings of JAX's own persistent cache, which keeps compiled programs between runs.

The settings are environment variables that JAX reads when it is imported, so no import of softfin
changes JAX. Only softfin's programs call `use_program_cache`. Variables that are already set win.
"""

import contextlib
import os
from pathlib import Path

SOFTFIN_VARIABLE = "SOFTFIN_CACHE"
OFF = "off"
JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"

MAX_CACHE_BYTES = 2**30
"""Size above which the least recently used programs are deleted [bytes]."""

JAX_SETTINGS = {
    # Small programs are kept, too: an evaluation in the tank has 45 of them, which take 30 ms each
    # to compile.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # On a GPU, XLA would write files of its own, which JAX would neither count nor delete.
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
}


def cache_folder() -> Path | None:
    """Return the folder of compiled programs, or None if the cache is off or the user has no
    home."""
    if jax_folder := os.environ.get(JAX_VARIABLE):
        return Path(jax_folder)
    chosen = os.environ.get(SOFTFIN_VARIABLE, "")
    if chosen == OFF:
        return None
    try:
        if chosen:
            return Path(chosen).expanduser().absolute()
        user_caches = Path(os.environ.get("XDG_CACHE_HOME", ""))
        return (user_caches if user_caches.is_absolute() else Path.home() / ".cache") / "softfin"
    except RuntimeError:
        return None


def describe_cache() -> str:
    """Describe the cache for ``softfin --help``."""
    folder = cache_folder()
    if folder is None:
        return f"Compiled programs are not kept; {SOFTFIN_VARIABLE}=FOLDER keeps them."
    return (
        f"Compiled programs are kept in {folder}, at most {MAX_CACHE_BYTES / 2**30:g} GiB;\n"
        f"{SOFTFIN_VARIABLE}=FOLDER moves them, {SOFTFIN_VARIABLE}={OFF} keeps none."
    )


def use_program_cache() -> None:
    """Make JAX keep compiled programs, if this process has not imported it yet."""
    folder = cache_folder()
    if folder is None:
        return
    os.environ[JAX_VARIABLE] = str(folder)
    for name, value in JAX_SETTINGS.items():
        os.environ.setdefault(name, value)
    delete_old_programs(folder, MAX_CACHE_BYTES)


def delete_old_programs(folder: Path, max_bytes: int) -> None:
    """Delete the least recently used programs until the folder is small enough.

    JAX can limit the size itself (`jax_compilation_cache_max_size`), but it then reads the whole
    folder for each program that it adds: with 2,000 programs in it, 60 ms each.
    """
    programs = []
    # Another process may delete programs at the same time, and the folder may not exist.
    with contextlib.suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            status = entry.stat()
            last_use = max(status.st_atime, status.st_mtime)
            programs.append((last_use, status.st_size, entry.path))
    size = sum(program_bytes for _, program_bytes, _ in programs)
    for _, program_bytes, path in sorted(programs):
        if size <= max_bytes:
            return
        with contextlib.suppress(OSError):
            Path(path).unlink()
        size -= program_bytes
