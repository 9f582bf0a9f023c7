"""Settings of JAX's persistent cache, which stores compiled programs between runs.

The settings are environment variables that JAX reads on import, so importing softfin does not
change JAX. Only softfin's programs call `use_program_cache`. Variables that are already set take
precedence.
"""

import os
from pathlib import Path

SOFTFIN_VARIABLE = "SOFTFIN_CACHE"
OFF = "off"
JAX_VARIABLE = "JAX_COMPILATION_CACHE_DIR"

JAX_SETTINGS = {
    # Also store small programs: an evaluation in the tank uses 45 of them, and each takes 30 ms to
    # compile.
    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
    # On a GPU, XLA would write additional files, which JAX would not count or delete.
    "JAX_PERSISTENT_CACHE_ENABLE_XLA_CACHES": "none",
}


def cache_folder() -> Path | None:
    """Return the folder of compiled programs, or None if the cache is off or the user has no home
    folder."""
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
        return f"Compiled programs are not cached; set {SOFTFIN_VARIABLE}=FOLDER to cache them."
    return (
        f"Compiled programs are cached in {folder}, which you can delete at any time.\nSet "
        f"{SOFTFIN_VARIABLE}=FOLDER to use a different folder, {SOFTFIN_VARIABLE}={OFF} to turn "
        "the cache off."
    )


def use_program_cache() -> None:
    """Make JAX cache compiled programs; must be called before this process imports JAX."""
    folder = cache_folder()
    if folder is None:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        # Otherwise, JAX would warn about every program.
        return
    os.environ[JAX_VARIABLE] = str(folder)
    for name, value in JAX_SETTINGS.items():
        os.environ.setdefault(name, value)
