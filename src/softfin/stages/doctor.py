"""Checks the computer on which softfin runs: packages, JAX, cache, disk, and the ports of a rig.

Nothing moves, and temporary files are removed immediately. You can paste the output into a bug
report.
"""

import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from softfin.core.errors import RunError, SoftfinError, one_line
from softfin.core.program_cache import SOFTFIN_VARIABLE, cache_folder
from softfin.installation import EXTRAS, extra_requirements, how_to_add, installed_version
from softfin.rig.check import check_disk
from softfin.rig.device import CheckResult, failing
from softfin.storage.artifact import check_writable

INTERFACES = Path("/sys/class/net")
"""Linux network interfaces, with the type and state of each."""

CAN_TYPE = "280"
"""Type number of a CAN interface (Linux's ARPHRD_CAN)."""

PORTS_FOLDER = Path("/dev")
"""Folder of the serial ports."""

SERIAL_PORTS = ("ttyUSB*", "ttyACM*", "cu.usb*")
"""Names of USB serial ports on Linux and macOS."""


def doctor() -> Iterator[CheckResult]:
    """Check the installation, JAX, the disk and the ports of this computer; nothing moves. Paste
    the output into bug reports. For a rig, use softfin rig check.

    Yields:
        Each result as soon as it is available; the home folder of the user is shortened to ~.

    Raises:
        RunError: If a check has failed.

    Example:
        >>> list(softfin.doctor())
    """
    home = os.environ.get("HOME", "/")
    for result in failing(_examine(), RunError):
        yield result._replace(text=result.text.replace(home, "~") if len(home) > 1 else result.text)


def _examine() -> Iterator[CheckResult]:
    yield CheckResult("softfin", "well", f"{installed_version('softfin')}, {Path(__file__).parent}")
    yield CheckResult("Python", "well", f"{platform.python_version()}, {sys.executable}")
    yield CheckResult("system", "well", f"{platform.platform()}, {os.cpu_count()} processors")
    yield _packages("packages", None, "wrong", "reinstall softfin")
    for extra in EXTRAS:
        yield _packages(f"[{extra}]", extra, "note", f"if you need it: {how_to_add(extra)}")
    if installed_version("jax") is not None:
        yield _jax()
    yield _cache()
    yield check_disk(Path.cwd())
    yield _can()
    yield _serial_ports()


def _packages(
    what: str, extra: str | None, state: Literal["note", "wrong"], fix: str
) -> CheckResult:
    versions = {name: installed_version(name) for name in extra_requirements(extra)}
    missing = [name for name, version in versions.items() if version is None]
    if missing:
        return CheckResult(what, state, f"lacks {', '.join(missing)}; {fix}")
    return CheckResult(what, "well", ", ".join(f"{name} {versions[name]}" for name in versions))


def _jax() -> CheckResult:
    try:
        import jax

        devices = jax.devices()
    except Exception as error:
        # JAX and its plug-ins raise many kinds of exceptions, e.g. for a plug-in of a different
        # version or for a missing device.
        return CheckResult(
            "JAX",
            "wrong",
            f"no device found ({one_line(error)}); set JAX_PLATFORMS=cpu to use the CPU",
        )
    return CheckResult("JAX", "well", ", ".join(map(str, devices)))


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
    # Bit 0 of the flags is IFF_UP. The folder exists only on Linux.
    states = {
        path.parent.name: int((path.parent / "flags").read_text(), 16) & 1
        for path in sorted(INTERFACES.glob("*/type"))
        if path.read_text().strip() == CAN_TYPE
    }
    text = ", ".join(f"{name} {'up' if is_up else 'down'}" for name, is_up in states.items())
    if not states:
        text = "no SocketCAN interface; an EPOS2 needs SocketCAN or a different CAN adapter"
    elif all(states.values()):
        return CheckResult("CAN", "well", text)
    else:
        text += "; run: sudo ip link set NAME up type can bitrate 1000000"
    return CheckResult("CAN", "note", text)


def _serial_ports() -> CheckResult:
    ports = sorted(path for name in SERIAL_PORTS for path in PORTS_FOLDER.glob(name))
    if not ports:
        return CheckResult("serial ports", "note", "none on USB; a Dynamixel needs one")
    text = ", ".join(map(str, ports))
    if all(os.access(port, os.R_OK | os.W_OK) for port in ports):
        return CheckResult("serial ports", "well", text)
    fix = (
        "you may lack permission to use some of them: run sudo usermod -aG dialout $USER, then log "
        "in again"
    )
    return CheckResult("serial ports", "note", f"{text}; {fix}")
