"""A Ray cluster in a network with nothing but loopback, because Ray listens more widely than it is
told: ``python -m tests.stages.ray_cluster FOLDER``."""

import fcntl
import json
import socket
import struct
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

from softfin.core.errors import RunError
from softfin.stages.controllers import train
from softfin.stages.ray_training import train_on_ray
from softfin.storage.artifact import WEIGHTS
from tests.stages.test_training import PPO

PLANT = "tests.plants:StrokeFin"
HEAD = """
import os, sys, ray
started = ray.init("local", include_dashboard=False, _node_ip_address="127.0.0.1", num_cpus=2,
                   object_store_memory=2**28, log_to_driver=False, logging_level="ERROR")
os.write(sys.stdout.fileno(), (started.address_info["gcs_address"] + "\\n").encode())
sys.stdin.read()
ray.shutdown()
"""
"""In a process without JAX, whose threads do not survive a fork."""


def raise_loopback() -> None:
    """The loopback of a new network is down; 0x8914 is SIOCSIFFLAGS, 0x41 up and running."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        fcntl.ioctl(any_socket, 0x8914, struct.pack("16sh14x", b"lo", 0x41))


def digest(folder: Path) -> str:
    return sha256((folder / WEIGHTS).read_bytes()).hexdigest()


def main(folder: Path) -> None:
    raise_loopback()
    (folder / "taken").mkdir()
    (folder / "taken" / "mine").touch()
    runs = {
        name: {"plant": PLANT, "out": folder / name, "config": PPO, "seed": seed}
        for name, seed in (("first", 0), ("second", 1), ("taken", 2), ("third", 3))
    }
    with subprocess.Popen(
        [sys.executable, "-P", "-c", HEAD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as head:
        assert head.stdout is not None
        cluster = head.stdout.readline().strip()
        results = train_on_ray([runs["first"], runs["second"]], cluster)
        error = ""
        try:
            train_on_ray([runs["taken"], runs["third"]], cluster)
        except RunError as failed:
            error = str(failed)
    for name in ("first", "second"):
        train(**{**runs[name], "out": folder / f"{name}-alone"})
    told = {
        "trained": [digest(Path(result["controller"])) for result in results],
        "alone": digest(folder / "first-alone"),
        "other": digest(folder / "second-alone"),
        "error": error,
        "finished": (folder / "third" / "controller.json").is_file(),
    }
    (folder / "told.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
