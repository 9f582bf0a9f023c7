"""Settings of JAX's own persistent cache, which keeps compiled programs between runs.

The settings are environment variables that JAX reads when it is imported, so no import of softfin
changes JAX. Only softfin's programs call `use_program_cache`. Variables that are already set win.
"""

import os
from pathlib import Path

SOFTFIN_VARIABLE = "SOFTFIN_CACHE"
OFF = "off"
JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"

MAX_CACHE_BYTES = 2**30
"""Size above which JAX deletes the programs that were used least recently [bytes]."""

JAX_SETTINGS = {
    "JAX_COMPILATION_CACHE_MAX_SIZE": str(MAX_CACHE_BYTES),
    # Small programs, too: an evaluation in the tank has 45 of them, which take 30 ms each to
    # compile.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # On a GPU, XLA would write files of its own, which JAX neither counts nor deletes.
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
