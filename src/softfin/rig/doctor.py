"""Check the computer that softfin runs on: installation, devices, disk and, if given, the rig.

Nothing moves, and temporary files are removed immediately. You can paste the output into an issue.
"""

import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

from softfin.core.errors import SoftfinError, one_line
from softfin.core.program_cache import SOFTFIN_VARIABLE, cache_folder
from softfin.installation import (
    EXTRAS,
    extra_requirements,
    how_to_add,
    installed_version,
    missing_from,
    origin,
)
from softfin.rig.check import check_disk, check_rig
from softfin.rig.config import load_rig
from softfin.rig.device import CheckResult
from softfin.rig.rig import Rig
from softfin.storage.artifact import check_writable

INTERFACES = Path("/sys/class/net")
"""Linux network interfaces, with the type and state of each."""

CAN_TYPE = "280"
"""Type number of a CAN interface (Linux's ARPHRD_CAN)."""

NVIDIA = Path("/proc/driver/nvidia/version")
"""File that exists if an NVIDIA GPU driver is loaded."""

SPARE_MEMORY_MB = 1300
"""Memory needed to fit a surrogate to as much data as in the paper (docs/surrogates.md) [MB]."""

RIG_SECONDS = 1.0
"""Duration of the 100 Hz loop test [s]."""

THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "XLA_FLAGS",
    "JAX_PLATFORMS",
)
"""Environment variables that set the number of threads and the compute device."""


def examine(rig: Path | None = None) -> Iterator[CheckResult]:
    """Yield each result as soon as it is available, with the user's home folder shortened to ~."""
    try:
        home = str(Path.home())
    except RuntimeError:
        # The user has no home folder, e.g. in some containers.
        home = ""
    for result in _examine(rig):
        yield result._replace(text=result.text.replace(home, "~") if len(home) > 1 else result.text)


def _examine(rig: Path | None) -> Iterator[CheckResult]:
    yield _softfin()
    yield CheckResult(
        "Python",
        "well",
        f"{platform.python_implementation()} {platform.python_version()}, {sys.executable}",
    )
    yield CheckResult("system", "well", platform.platform())
    yield _processor()
    yield from _memory()
    yield _libraries()
    yield from map(_extra, EXTRAS)
    yield _devices()
    yield _cache()
    yield check_disk(Path.cwd())
    found = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if name in os.environ)
    yield CheckResult("threads", "well", found or "default of each library")
    yield _can()
    if rig is not None:
        yield from _rig(rig)


def _softfin() -> CheckResult:
    source = origin()
    place = "installed from a source that pip did not record" if source is None else source["url"]
    in_place = source is not None and source.get("dir_info", {}).get("editable")
    return CheckResult(
        "softfin",
        "well",
        f"{installed_version('softfin')}, {place}{', editable install' if in_place else ''}",
    )


def _processor() -> CheckResult:
    model = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        model = next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass
    cores = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    is_busy = load > cores
    advice = "; other programs use it: timings and the 100 Hz loop will suffer" if is_busy else ""
    text = f"{model}, {cores} cores, load {load:.1f}{advice}"
    return CheckResult("processor", "note" if is_busy else "well", text)


def _memory() -> Iterator[CheckResult]:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return
    # A kB in /proc/meminfo is 1024 bytes, an MB here is 10^6 bytes.
    sizes = {
        line.partition(":")[0]: int(line.split()[1]) * 1024e-6
        for line in lines
        if line.endswith("kB")
    }
    # Old kernels do not report MemAvailable.
    free = sizes.get("MemAvailable", sizes["MemFree"])
    is_enough = free >= SPARE_MEMORY_MB
    advice = (
        ""
        if is_enough
        else f"; fitting a surrogate takes up to {SPARE_MEMORY_MB} MB: close other programs"
    )
    text = f"{sizes['MemTotal']:,.0f} MB, {free:,.0f} MB available{advice}"
    yield CheckResult("memory", "well" if is_enough else "note", text)


def _libraries() -> CheckResult:
    missing = missing_from(None)
    if missing:
        return CheckResult(
            "libraries", "wrong", f"not installed: {', '.join(missing)}; reinstall softfin"
        )
    return CheckResult("libraries", "well", _versions(extra_requirements(None)))


def _extra(extra: str) -> CheckResult:
    missing = missing_from(extra)
    shared = extra_requirements("learn") if extra != "learn" else []
    names = [name for name in extra_requirements(extra) if name not in shared]
    if not names:
        return CheckResult(
            f"[{extra}]", "note", "not known to the installed package; reinstall softfin"
        )
    if not missing:
        return CheckResult(f"[{extra}]", "well", _versions(names))
    present = "not installed" if set(names) <= set(missing) else f"lacks {', '.join(missing)}"
    return CheckResult(f"[{extra}]", "note", f"{present}; if you need it: {how_to_add(extra)}")


def _versions(names: list[str]) -> str:
    return ", ".join(f"{name} {installed_version(name)}" for name in names)


def _devices() -> CheckResult:
    if installed_version("jax") is None:
        return CheckResult(
            "JAX", "note", "not installed: this softfin can run controllers but not train them"
        )
    try:
        import jax

        devices = jax.devices()
    except Exception as error:
        # JAX and its plug-ins raise many kinds of exceptions, e.g. for a plug-in of another version
        # or a driver without a device.
        return CheckResult(
            "JAX",
            "wrong",
            f"no device found ({one_line(error)}); set JAX_PLATFORMS=cpu to use the CPU",
        )
    kinds = ", ".join(f"{device.platform}:{device.id} {device.device_kind}" for device in devices)
    kinds += f", jaxlib {installed_version('jaxlib')}"
    if NVIDIA.exists() and devices[0].platform == "cpu" and "JAX_PLATFORMS" not in os.environ:
        advice = "; the NVIDIA GPU is not used; to use it, run: pip install 'jax[cuda12]'"
        return CheckResult("JAX", "note", f"{kinds}{advice}")
    return CheckResult("JAX", "well", kinds)


def _cache() -> CheckResult:
    folder = cache_folder()
    if folder is None:
        advice = f"off: every command compiles again; set {SOFTFIN_VARIABLE}=FOLDER to use a cache"
        return CheckResult("compile cache", "note", advice)
    try:
        check_writable(folder / "program", f"{SOFTFIN_VARIABLE}=FOLDER")
    except SoftfinError as error:
        return CheckResult("compile cache", "wrong", str(error))
    return CheckResult("compile cache", "well", str(folder))


def _can() -> CheckResult:
    if not INTERFACES.is_dir():
        return CheckResult(
            "CAN", "note", f"interfaces can be listed only on Linux; this is {platform.system()}"
        )
    # Bit 0 of the flags is IFF_UP.
    states = {
        path.name: int((path / "flags").read_text(), 16) & 1
        for path in sorted(INTERFACES.iterdir())
        if (path / "type").is_file() and (path / "type").read_text().strip() == CAN_TYPE
    }
    if not states:
        return CheckResult(
            "CAN",
            "note",
            "no SocketCAN interface; a rig needs one or another adapter supported by python-can",
        )
    text = ", ".join(f"{name} {'up' if is_up else 'down'}" for name, is_up in states.items())
    down = next((name for name, is_up in states.items() if not is_up), None)
    if down is None:
        return CheckResult("CAN", "well", text)
    return CheckResult(
        "CAN", "note", f"{text}; run: sudo ip link set {down} up type can bitrate 1000000"
    )


def _rig(path: Path) -> Iterator[CheckResult]:
    try:
        yield from check_rig(Rig(load_rig(path)), path.absolute().parent, RIG_SECONDS)
    except SoftfinError as error:
        yield CheckResult("rig file", "wrong", str(error))
