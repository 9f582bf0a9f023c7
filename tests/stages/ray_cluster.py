"""A Ray cluster in a network with nothing but loopback, because Ray listens more widely than it is
told: ``python -m tests.stages.ray_cluster FOLDER``."""

import json
import subprocess
import sys
from hashlib import sha256
from pathlib import Path

from softfin.core.errors import RunError
from softfin.stages.controllers import train
from softfin.stages.ray_training import train_on_ray
from softfin.storage.artifact import WEIGHTS
from tests.alone import raise_loopback
from tests.patience import HANG_S
from tests.stages.test_training import PPO

PLANT = "tests.plants:StrokeFin"
CLUSTER = "127.0.0.1:6399"
START = (
    *(sys.executable, "-m", "ray.scripts.scripts", "start", "--head", "--port=6399"),
    *("--node-ip-address=127.0.0.1", "--num-cpus=2", "--object-store-memory=100000000"),
    *("--include-dashboard=false", "--disable-usage-stats"),
)


def digest(folder: Path) -> str:
    return sha256((folder / WEIGHTS).read_bytes()).hexdigest()


def main(folder: Path) -> None:
    raise_loopback()
    (folder / "taken").mkdir()
    (folder / "taken" / "mine").touch()
    runs = {
        name: {"surrogate": PLANT, "out": folder / name, "config": PPO, "seed": seed}
        for name, seed in (("first", 0), ("second", 1), ("taken", 2), ("third", 3))
    }
    subprocess.run(START, check=True, timeout=HANG_S)
    results = train_on_ray([runs["first"], runs["second"]], CLUSTER)
    error = ""
    try:
        train_on_ray([runs["taken"], runs["third"]], CLUSTER)
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
