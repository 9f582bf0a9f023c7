"""Engines: this process, and Ray, where it is installed and a network of its own can be had."""

import socket
import sys
import types
from pathlib import Path

import pytest

from softfin.core.errors import ConfigurationError, RunError
from softfin.learning.engine import Engine, find_engine
from tests.learning.ray_cluster import SMALL, within


def test_the_local_engine_keeps_the_order_and_tells_how_far_all_parts_are():
    said = []

    def double(item, progress):
        progress("inner", 0.5, "half")
        return 2 * item

    results = Engine().map("double", double, {"one": 1, "ten": 10}, lambda *note: said.append(note))
    assert results == [2, 20]
    assert said == [("double", 0.25, "one: half"), ("double", 0.75, "ten: half")]


def test_a_part_that_fails_ends_the_local_run():
    begun = []

    def fail(item, _):
        begun.append(item)
        raise RunError("out of water")

    with pytest.raises(RunError, match="out of water"):
        Engine().map("fail", fail, {"a": 0, "b": 1}, None)
    assert begun == [0]


def test_engines_are_found_by_name():
    assert type(find_engine("local")) is Engine
    with pytest.raises(ConfigurationError, match="cluster here:1: the local engine has none; give --engine ray"):
        find_engine("local", "here:1")


def test_without_ray_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigurationError, match=r"^--engine ray needs ray, .*pip install .*\[ray\]"):
        find_engine("ray", "127.0.0.1:6399")


@pytest.mark.parametrize(
    ("cluster", "message"),
    [
        ("127.0.0.1:{unused}", r"nothing answers there \(.*refused\); give --cluster HOST:PORT as `ray start --head` "),
        ("no-such-host.invalid:6379", r"nothing answers there \(.*\); give --cluster HOST:PORT"),
        ("auto", "not an address HOST:PORT; give --cluster HOST:PORT"),
        ("127.0.0.1:65536", "not an address HOST:PORT"),
    ],
)
def test_a_cluster_that_is_not_there_is_told_at_once_in_one_line(cluster, message, monkeypatch: pytest.MonkeyPatch):
    """Before Ray does anything: one that is installed, and no more, stands in for it."""
    monkeypatch.setitem(sys.modules, "ray", types.ModuleType("ray"))
    with socket.socket() as bound:
        # A port that nobody else gets, and where nobody listens.
        bound.bind(("127.0.0.1", 0))
        cluster = cluster.format(unused=bound.getsockname()[1])
        with pytest.raises(ConfigurationError, match=f"^cluster {cluster}: {message}"):
            find_engine("ray", cluster)


@pytest.mark.slow
def test_a_cluster_of_this_machine_works_on_other_processes_and_leaves_none(tmp_path: Path):
    told = within("own", tmp_path)
    assert [square for _, square in told["squares"]] == [0, 1, 4, 9]
    assert told["pid"] not in {pid for pid, _ in told["squares"]}
    assert sorted(round(4 * done) for _, done, _ in told["said"]) == [1, 2, 3, 4]
    assert (told["left"], told["connected"], told["home"]) == ([], False, [])


@pytest.mark.slow
def test_cells_on_two_nodes_learn_the_same_bits_as_here_though_a_worker_is_killed_in_the_middle(tmp_path: Path):
    told = within("cells", tmp_path)
    assert told["deaths"] == 1
    assert [note for stage, _, note in told["said"] if stage == "lost worker"] == [
        "seed-1-cell-0 runs again, attempt 2 of 3"
    ]
    assert len([stage for stage, _, _ in told["said"] if stage == "train grid"]) == 4
    assert told["steps"] == [SMALL.ppo.steps_per_update * (i + 1) for i in range(SMALL.num_updates)]
    assert told["begun"] == [0, 2]


@pytest.mark.slow
def test_a_part_that_fails_for_good_is_told_in_one_line_when_the_others_are_done(tmp_path: Path):
    told = within("failures", tmp_path)
    assert told["_refuse"][:2] == ["RunError", "part: out of water"]
    assert told["_fail"][:2] == ["RunError", "part: its worker failed with IndexError: no such fin"]
    kind, message, said = told["_die"]
    assert kind == "RunError"
    assert message.startswith("part: its worker died 2 times (The worker died unexpectedly while executing this task")
    assert message.endswith("what is finished is kept: look after memory and machines, and --resume")
    assert ["lost worker", 1, "part runs again, attempt 2 of 2"] in said
    assert told["finished"] == ["dead-other", "failed-other", "refused-other"]


@pytest.mark.slow
def test_the_documented_commands_write_the_same_bits_here_and_on_ray(tmp_path: Path):
    told = within("commands", tmp_path)
    assert told["own"] == told["cluster"] == told["local"]
