"""Processes in a network of their own with nothing but loopback, where that can be had."""

import fcntl
import json
import os
import shutil
import socket
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

from tests.patience import HANG_S

ROOT = Path(__file__).parents[1]

ALONE = ("unshare", "--map-root-user", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
"""A network and processes of its own: whatever was started in there ends with the first."""


@cache
def namespace() -> tuple[str, ...]:
    """What stands before a command that is to be alone; nothing where that cannot be had."""
    if (
        shutil.which(ALONE[0]) is None
        or subprocess.run([*ALONE, "true"], capture_output=True).returncode
    ):
        return ()
    return ALONE


def told_by(module: str, folder: Path, *words: str, **environment: str) -> dict[str, Any]:
    """What ``python -m module WORDS FOLDER`` writes into told.json."""
    run = subprocess.run(
        [*namespace(), sys.executable, "-m", module, *words, str(folder)],
        env=os.environ | environment | {"ALONE": "yes" if namespace() else ""},
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=HANG_S,
    )
    assert run.returncode == 0, run.stderr[-4000:]
    told: dict[str, Any] = json.loads((folder / "told.json").read_text())
    return told


def raise_loopback() -> None:
    """Called by a process that is alone, because the loopback of a new network is down; 0x8914 is
    SIOCSIFFLAGS, 0x41 up and running."""
    if not os.environ["ALONE"]:
        return
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", 0x41))
