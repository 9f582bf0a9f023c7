import os
import socket
from pathlib import Path

import pytest

from softfin.control.native.files import read_folder
from softfin.core.configuration import read_yaml
from softfin.core.errors import InputError
from softfin.core.files import regular_file
from softfin.data.importing.importing import ImportConfig
from softfin.data.importing.recordings import find_recordings
from softfin.data.importing.rosbag import read_bag
from softfin.data.importing.tables import read_table
from softfin.rig.config import load_rig
from softfin.rig.monitor.follow import Follower
from softfin.storage import artifact as artifacts
from softfin.storage.bag.recovery import recover
from softfin.storage.dataset import Dataset
from softfin.storage.log_file import read_log
from softfin.storage.run_directory import Workspace
from softfin.surrogate.paper.keras import read_network, read_scalers
from softfin.task.reference_file import read_reference_file

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="without pipes in folders")


def folder(file, **others):
    """A folder with a pipe in it, and other files."""

    def make(path):
        for name, text in others.items():
            (path / name.replace("__", ".")).write_text(text)
        os.mkfifo(path / file)
        return path

    return make


def lone(name):
    def make(path):
        os.mkfifo(path / name)
        return path / name

    return make


def dataset(path):
    (path / "train").mkdir()
    (path / "dataset.json").write_text("{}")
    os.mkfifo(path / "train" / "0.parquet")
    return path


def unfinished(path):
    (path / ".out.unfinished").mkdir()
    os.mkfifo(path / ".out.unfinished" / "checkpoint.safetensors")
    return path


READERS = {
    "yaml": (lone("x.yaml"), read_yaml),
    "json": (lone("x.json"), artifacts.read_json),
    "rig": (lone("rig.yaml"), load_rig),
    "log": (lone("x.parquet"), read_log),
    "csv": (lone("x.csv"), lambda path: read_table(path, "x", "train", ImportConfig())),
    "parquet": (lone("x.parquet"), lambda path: read_table(path, "x", "train", ImportConfig())),
    "reference csv": (lone("x.csv"), read_reference_file),
    "reference parquet": (lone("x.parquet"), read_reference_file),
    "keras": (lone("x.keras"), lambda path: read_network(path, ("a",), ("b",))),
    "scalers": (lone("x.json"), read_scalers),
    "mcap": (lone("x.mcap"), lambda path: read_bag(path, "x", "train", ImportConfig())),
    "recover": (lone("x.mcap"), lambda path: recover(path, path.with_name("out.mcap"))),
    "recordings": (lone("x.mcap"), find_recordings),
    "bag": (folder("x.db3", metadata__yaml=""), lambda path: read_bag(path, "x", "train", ImportConfig())),
    "dataset": (dataset, Dataset.open),
    "artifact": (folder("weights.safetensors", surrogate__json="{}"), lambda path: artifacts.load(path, "surrogate")),
    "checkpoint": (unfinished, lambda path: Workspace(path / "out", {}, resume=True)),
}


@pytest.mark.parametrize("name", READERS)
def test_a_pipe_is_refused_in_one_line_before_it_is_opened(name, tmp_path):
    make, read = READERS[name]
    with pytest.raises(InputError, match="a pipe, not a file") as refused:
        read(make(tmp_path))
    assert str(tmp_path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_pipes_that_only_look_like_files_of_ours_are_none(tmp_path):
    os.mkfifo(tmp_path / "controller.json")
    os.mkfifo(tmp_path / "x.mcap")
    with pytest.raises(InputError, match=r"holds no controller\.json"):
        read_folder(tmp_path)
    with pytest.raises(InputError, match="neither a file nor a folder"):
        Follower(tmp_path / "x.mcap")


def test_what_is_no_file_is_called_by_its_kind(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to(tmp_path / "file")
    assert regular_file(tmp_path / "link") == tmp_path / "link"
    with pytest.raises(OSError, match="a folder, not a file"):
        regular_file(tmp_path)
    with pytest.raises(OSError, match="a device, not a file"):
        regular_file(Path("/dev/null"))
    with pytest.raises(FileNotFoundError):
        regular_file(tmp_path / "none")


def test_a_socket_is_no_file(tmp_path, monkeypatch):
    # By a short name: paths of sockets are.
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("x.yaml")
        with pytest.raises(InputError, match="a socket, not a file"):
            read_yaml(tmp_path / "x.yaml")
