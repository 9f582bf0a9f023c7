"""What the commands of the documents name, at tiny sizes: logs, networks with random weights,
controllers.

Nothing is recorded, learnt or searched for: what is asked of them is to be there and to be read.
"""

import csv
import fcntl
import os
import zlib
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType

import equinox as eqx
import numpy as np
import pytest
import yaml

from softfin.core.plant_identity import identity
from softfin.core.quantities import PAPER_LIMITS
from softfin.learning.configuration import SINGLE
from softfin.learning.controllers import save_policies
from softfin.storage.dataset import write_dataset
from softfin.storage.registry import find_plant
from softfin.surrogate import Surrogate, save_surrogate
from softfin.surrogate.channels import COMMAND_COLUMNS, ChannelScaling, Scaling
from softfin.surrogate.streaming import profile
from tests.control.test_controllers import untrained
from tests.data import bags
from tests.data.faulty import to_columns
from tests.data.recorded import record
from tests.documents import ROOT
from tests.gaits.known import save_known
from tests.surrogate import small as paper
from tests.surrogate.streaming import small as streaming

PLANT = "tests.plants:AnalyticFin"
COARSE = {"fin": {"plates": 2}, "steps_per_tick": 4}
"""A tank whose programs are compiled in half the time."""

ROWS = 700
"""Of a log."""

AUTHORS = MappingProxyType(
    {
        "command angle": "command_angle_rad",
        "command velocity": "command_velocity_rad_s",
        "position": "angle_rad",
        "force x": "force_x_n",
        "force y": "force_y_n",
    }
)
"""Their columns, and softfin's."""

MAPPING = ",".join(
    f"{own.removesuffix('_rad').removesuffix('_n').removesuffix('_rad_s')}={name}"
    for name, own in AUTHORS.items()
)
"""What ``...`` stands for behind --columns."""

FIT = {
    "epochs": 1,
    "batch": 64,
    "posnet": paper.POSNET.model_dump(mode="json"),
    "forcenet": paper.FORCENET.model_dump(mode="json"),
}
STREAMING = streaming.CONFIG.model_dump(mode="json") | {"drive_updates": 2, "force_updates": 2}

SIZE = {
    "num_evaluations": 1,
    "lattice": 1,
    "policy": {"units": 8, "width": 8},
    "task": {"episode_actions": 9},
}
SURVEY = {"batch": 704, "directions": 8, "pushes": 0}
PPO = {"num_envs": 2, "num_steps": 3, "num_epochs": 1, "num_minibatches": 1}
TRAIN = {**SIZE, "steps": 6, "ppo": PPO}
MAP = {
    "survey": SURVEY,
    "gaits": {"steps": 6},
    "box": {"low": [1, -1], "high": [2, 0]},
    "spacing_n": 1,
}
CALIBRATE = {
    "segments": 4,
    "test_segments": 4,
    "segment_s": 1,
    "warm_up_s": 0.2,
    "iterations": 1,
    "tank": COARSE,
}

BENCHMARK = {
    "seconds": 4,
    "seeds": 1,
    "widths": [0.3],
    "tanks": 2,
    "change_s": 4,
    "rates_hz": [0.4],
    "rate_seconds": 5,
    "rate_settle_s": 2,
}

CONFIGURATIONS = MappingProxyType(
    {
        "benchmark.yaml": BENCHMARK,
        "streaming.yaml": STREAMING,
        "paper.yaml": FIT,
        "map.yaml": MAP,
        "train.yaml": TRAIN,
        # The parameters of the document, so that one program calibrates in both.
        "calibrate.yaml": yaml.safe_load((ROOT / "docs/calibration.yaml").read_text()) | CALIBRATE,
        "tank.yaml": COARSE,
    }
)
"""Files for --config that make each stage as small as it can be."""


@pytest.fixture
def short_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a search finds is tested with it; here it only has to go through."""
    for module in ("config", "calibrate"):
        monkeypatch.setattr(f"softfin.tank.calibration.{module}.BLOCK_S", 0.04)
    monkeypatch.setattr(profile, "GENERATIONS", 2)
    monkeypatch.setattr(profile, "SEGMENTS", 4)


@pytest.fixture
def no_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are laid out where they are looked at; here their files are only written."""
    monkeypatch.setattr("softfin.storage.figures._render", lambda *_, **__: b"<svg></svg>")


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """What MAKERS make, made when it is first asked for and then shared by all workers."""
    own = tmp_path_factory.getbasetemp()
    root = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "made"

    def find(name: str) -> Path:
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with (root / "lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                MAKERS[name](path)
        return path

    return find


def dataset(path: Path) -> None:
    """Three logs and one to score on, as if of the tank."""
    logs = [streaming.recorded(ROWS, seed) for seed in range(4)]
    write_dataset(
        path, logs[:3], logs[3:], {"plant": PLANT, "plant_identity": identity(find_plant(PLANT))}
    )


def recordings(path: Path) -> None:
    """CSV files with softfin's columns."""
    path.mkdir()
    for seed, name in enumerate(("first", "second", "third", "test")):
        _csv(path / f"{name}.csv", to_columns(streaming.recorded(ROWS, seed)))


def authors(path: Path) -> None:
    """One CSV file of two logs, end to end, in degrees, with swapped axes and without a column of
    time."""
    path.mkdir()
    logs = [to_columns(streaming.recorded(ROWS, seed)) for seed in range(2)]
    whole = {name: np.concatenate([log[own] for log in logs]) for name, own in AUTHORS.items()}
    for name in ("command angle", "command velocity", "position"):
        whole[name] = np.rad2deg(whole[name])
    # What softfin's x and y are in it: -y, x.
    whole["force x"], whole["force y"] = whole["force y"], -whole["force x"]
    _csv(path / "final_dataset.csv", whole)


def run_csv(path: Path) -> None:
    """A CSV file with names and units of one's own, and without a velocity of the command."""
    columns = to_columns(streaming.recorded(ROWS))
    own = {
        "t [ms]": columns["time_s"] * 1000,
        "cmd angle [deg]": np.rad2deg(columns["command_angle_rad"]),
        "theta [deg]": np.rad2deg(columns["angle_rad"]),
        "Fx [N]": columns["force_x_n"],
        "Fy [N]": columns["force_y_n"],
        "temperature": np.full(ROWS, 20.0),
    }
    _csv(path, own)


def _csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def bag(path: Path) -> None:
    """A folder of a robot's bag, with topics of its own."""
    columns = to_columns(streaming.recorded(ROWS))
    renamed = {"/fin/joint_states": "/joint_states", "/fin/wrench": "/ft_sensor/wrench"}
    topics = bags.topics_of(columns, ROWS)
    for _, message in topics["/fin/joint_states"]:
        message.name[:] = ["tail"]
    bags.write_bag(path, {renamed.get(name, name): messages for name, messages in topics.items()})


def mcap(path: Path) -> None:
    """softfin's own recording."""
    path.parent.mkdir(parents=True, exist_ok=True)
    record(path, rows=ROWS)


def surrogate(path: Path) -> None:
    """Streaming networks."""
    fitted = streaming.surrogate()
    # Others of one configuration differ by what they learnt.
    fitted = eqx.tree_at(
        lambda s: s.members.force.offset,
        fitted,
        replace_fn=lambda x: x + zlib.crc32(path.name.encode()) % 100,
    )
    origin = {"data_hash": "dataset"}
    save_surrogate(path, fitted, None, origin, configuration=STREAMING, stroke_s=0.31)


def paper_surrogate(path: Path) -> None:
    """The paper's networks, for all commands that a controller gives."""
    nets = paper.surrogate()
    scaling = dict(nets.scaling.channels)
    for name, low, high in zip(
        COMMAND_COLUMNS, (PAPER_LIMITS.angle_min, 0.5), (PAPER_LIMITS.angle_max, 3.2), strict=True
    ):
        width = high - low
        scaling[name] = ChannelScaling(
            scale=1 / width, offset=-low / width, data_min=low, data_max=high
        )
    nets = Surrogate(nets.posnet, nets.forcenet, Scaling(channels=scaling))
    save_surrogate(path, nets, None, {"data_hash": path.name}, configuration=FIT)


def controller(path: Path) -> None:
    """One policy for all references."""
    path.parent.mkdir(parents=True, exist_ok=True)
    save_policies(path, untrained(SINGLE), {"seed": 5}, {})


def gaits(path: Path) -> None:
    """A table of gaits."""
    save_known(path)


MAKERS = MappingProxyType(
    {
        "dataset": dataset,
        "same": dataset,
        "two": dataset,
        "five": dataset,
        "recordings": recordings,
        "authors": authors,
        "run.csv": run_csv,
        "run1": bag,
        "run.mcap": mcap,
        "dataset-bags/train-0000.mcap": mcap,
        "surrogate": surrogate,
        "other": surrogate,
        "first": surrogate,
        "streaming-0": surrogate,
        "streaming-1": surrogate,
        "streaming-2": surrogate,
        "paper-0": paper_surrogate,
        "published": paper_surrogate,
        "controller": controller,
        "single": controller,
        "run/single": controller,
        "gaits": gaits,
    }
)
"""By the names that the documents give."""
