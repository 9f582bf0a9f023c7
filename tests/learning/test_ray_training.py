"""Training on Ray, where it is installed and a network of its own can be had."""

import socket
import sys
import types
from pathlib import Path

import pytest

from softfin.core.errors import ConfigurationError
from softfin.learning.ray_training import check_cluster, split_into_tasks
from softfin.stages.controllers import train
from tests.learning.ray_cluster import SMALL, within


def test_several_seeds_are_a_task_each_and_one_seed_is_a_task_per_cell():
    by_seed = split_into_tasks(SMALL, (4, 7))
    assert [(task.name, task.seeds, task.config.cells) for task in by_seed] == [
        ("seed-4", (4,), SMALL.cells),
        ("seed-7", (7,), SMALL.cells),
    ]
    by_cell = split_into_tasks(SMALL, (4,))
    assert [(task.name, task.seeds, task.config.cells) for task in by_cell] == [
        ("seed-4-cell-0", (4,), SMALL.cells[:1]),
        ("seed-4-cell-1", (4,), SMALL.cells[1:]),
    ]


def test_a_cluster_without_ray_is_refused(tmp_path: Path):
    with pytest.raises(
        ConfigurationError, match="cluster here:1: not used by the local engine; use --engine ray"
    ):
        train("tests.plants:AnalyticFin", tmp_path / "out", cluster="here:1")


def test_without_ray_it_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(
        ConfigurationError, match=r"^--engine ray: Ray is not installed; .*pip install .*\[ray\]"
    ):
        check_cluster("127.0.0.1:6399")


@pytest.mark.parametrize(
    ("cluster", "message"),
    [
        (
            "127.0.0.1:{unused}",
            r"cannot connect \(.*refused\); use --cluster HOST:PORT with the address that `ray start ",
        ),
        ("no-such-host.invalid:6379", r"cannot connect \(.*\); use --cluster HOST:PORT"),
        ("auto", "invalid address; use --cluster HOST:PORT"),
        ("127.0.0.1:65536", "invalid address"),
    ],
)
def test_a_cluster_that_is_not_there_is_told_at_once_in_one_line(
    cluster, message, monkeypatch: pytest.MonkeyPatch
):
    """Before Ray does anything: one that is installed, and no more, stands in for it."""
    monkeypatch.setitem(sys.modules, "ray", types.ModuleType("ray"))
    with socket.socket() as bound:
        # A port that nobody else gets, and where nobody listens.
        bound.bind(("127.0.0.1", 0))
        cluster = cluster.format(unused=bound.getsockname()[1])
        with pytest.raises(ConfigurationError, match=f"^cluster {cluster}: {message}"):
            check_cluster(cluster)


@pytest.mark.slow
def test_a_cluster_of_this_machine_learns_the_same_bits_as_this_process_and_leaves_nothing(
    tmp_path: Path,
):
    told = within("own", tmp_path)
    assert [round(2 * done) for _, done, _ in told["said"]] == [1, 2]
    assert (told["left"], told["connected"], told["home"]) == ([], False, [])


@pytest.mark.slow
def test_two_nodes_learn_the_same_bits_as_this_process_though_a_worker_is_killed_in_the_middle(
    tmp_path: Path,
):
    told = within("cells", tmp_path)
    assert told["deaths"] == 1
    assert len(told["said"]) == 2
    assert told["steps"] == [SMALL.ppo.steps_per_update * (i + 1) for i in range(SMALL.num_updates)]
    assert told["begun"] == [0, 2]


@pytest.mark.slow
def test_a_task_that_fails_for_good_is_told_in_one_line_when_the_others_are_done(tmp_path: Path):
    told = within("failures", tmp_path)
    last_step = SMALL.ppo.steps_per_update * SMALL.num_updates
    assert told["refuse"] == ["RunError", "seed-0: out of water", last_step]
    assert told["fail"] == [
        "RunError",
        "seed-0: its worker failed with IndexError: no such fin",
        last_step,
    ]
    kind, message, finished = told["die"]
    assert (kind, finished) == ("RunError", last_step)
    assert message.startswith("seed-0: its worker died 3 times (")
    assert message.endswith("finished tasks are kept; check memory and machines, then use --resume")


@pytest.mark.slow
def test_the_documented_commands_write_the_same_bits_on_either_cluster(tmp_path: Path):
    told = within("commands", tmp_path)
    assert told["own"] == told["cluster"]
