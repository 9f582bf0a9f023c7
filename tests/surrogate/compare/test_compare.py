import functools
from pathlib import Path

import jax
import numpy as np
import pytest

from softfin.core.errors import ConfigurationError, LogError
from softfin.core.quantities import Log, Reading
from softfin.core.window import interval
from softfin.surrogate import save_surrogate
from softfin.surrogate.compare.compare import (
    Candidate,
    CompareConfig,
    beyond_limits,
    candidates,
    compare_surrogates,
)
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.streaming.ensemble import Interval
from tests.plants import AnalyticFin
from tests.surrogate import small

CONFIG = CompareConfig(horizons_s=(1, 2.5))
LOGS = [small.log(rows=560, seed=seed) for seed in (1, 2)]


class Attentive(Surrogate):
    """Of another kind: needs more history than it sees, and states an interval."""

    model = "attentive"

    @property
    def memory(self):
        return 40

    @property
    def interval(self):
        return Interval(coverage=0.9, factor=3.0, floor_n=0.5, windows=1, logs=10)

    @property
    def size(self):
        return 1

    def member(self, index):
        return self

    def distance(self, state):
        return jax.numpy.zeros(())

    def advance_members(self, state, command, ticks):
        state, reading = self.advance(state, command, ticks)
        return state, jax.tree.map(lambda x: x[None], reading)


def candidate(seed, group="a", kind=Surrogate, folder=None):
    one = small.surrogate(seed)
    return Candidate(
        Path(folder or f"{group}-{seed}"), kind(one.posnet, one.forcenet, one.scaling), group
    )


def saved(path, seed=0, configuration=None, data_hash="d"):
    save_surrogate(
        path,
        small.surrogate(seed),
        None,
        {"data_hash": data_hash, "seed": seed},
        configuration=configuration,
    )
    return path


@functools.cache
def compared():
    found = [candidate(0), candidate(1), candidate(2), candidate(0, "b", Attentive)]
    return compare_surrogates(found, LOGS, CONFIG, noise_floor=("fin", AnalyticFin()))


def test_seeds_of_one_configuration_and_dataset_are_one_group(tmp_path):
    paths = [
        saved(tmp_path / "a", 0, {"epochs": 1, "batch": 2}),
        saved(tmp_path / "b", 1, {"batch": 2, "epochs": 1}),
        saved(tmp_path / "c", 2, {"epochs": 2, "batch": 2}),
        saved(tmp_path / "d", 3, {"epochs": 1, "batch": 2}, data_hash="other"),
        saved(tmp_path / "e", 4, None),
        saved(tmp_path / "f", 5, None),
    ]
    groups = [each.group for each in candidates(paths)]
    assert groups[0] == groups[1]
    assert len(set(groups)) == 5


@pytest.mark.parametrize("again", ["a", "../here/a"])
def test_a_folder_given_twice_is_refused(tmp_path, again):
    folder = saved(tmp_path / "here" / "a")
    with pytest.raises(
        ConfigurationError,
        match="a: duplicate surrogate, or a copy of another one; list each surrogate once",
    ):
        candidates([folder, tmp_path / "here" / again])
    with pytest.raises(ConfigurationError, match="duplicate surrogate"):
        candidates([folder, folder])


def test_a_copy_of_a_surrogate_is_no_second_seed(tmp_path):
    one = saved(tmp_path / "a")
    copy = saved(tmp_path / "b")
    with pytest.raises(ConfigurationError, match="b: duplicate surrogate, or a copy of another"):
        candidates([one, copy])


def test_no_surrogate_at_all_is_refused():
    with pytest.raises(ConfigurationError, match="missing surrogates: add the folders"):
        candidates([])


def test_groups_of_one_model_are_told_apart_by_their_folders():
    def names(*found):
        return [
            row["name"]
            for row in compare_surrogates(found, LOGS, CompareConfig(horizons_s=(0.2,))).summary[
                "groups"
            ]
        ]

    assert names(candidate(0), candidate(1), candidate(2, "b", Attentive)) == ["paper", "attentive"]
    assert names(candidate(0, "x"), candidate(1, "x"), candidate(2, "y")) == [
        "paper (x-0)",
        "paper (y-2)",
    ]


def test_all_surrogates_are_scored_on_the_same_rows():
    # The attentive one needs 40 rows to be warm, so all begin there.
    comparison = compared()
    assert comparison.summary["scored"] == [
        {"segments": 10, "rows": 1000, "rows_left": 120},
        {"segments": 4, "rows": 1000, "rows_left": 120},
    ]
    np.testing.assert_array_equal(
        comparison.measured.reading.force[1], LOGS[0].reading.force[290:540]
    )
    # The same weights with the same rows have the same errors, whatever the kind is called.
    paper, attentive = comparison.groups
    assert paper.longest[0].scores["force_mae_n"] == attentive.longest[0].scores["force_mae_n"]


def test_a_score_is_the_mean_over_the_seeds_with_its_interval():
    comparison = compared()
    row = comparison.summary["groups"][0]
    each = np.array([run.scores["force_x_rmse_n"] for run in comparison.groups[0].longest])
    assert len(set(each)) == 3
    assert row["seeds"] == 3
    assert row["surrogates"] == ["a-0", "a-1", "a-2"]
    assert row["horizons"][1]["force_x_rmse_n"] == {
        "mean": pytest.approx(each.mean()),
        "interval": interval(each),
    }
    assert comparison.summary["groups"][1]["horizons"][1]["force_x_rmse_n"]["interval"] is None


def test_cost_is_stated_and_compared_with_the_paper():
    rows = compared().summary["groups"]
    assert rows[0]["parameters"] == small.surrogate().parameters()
    assert [row["flops_ratio"] for row in rows] == [1.0, 1.0]
    assert compared().summary["flops_ratio_to"] == "paper"


def test_only_surrogates_that_state_intervals_have_a_coverage():
    paper, attentive = compared().summary["groups"]
    assert "coverage" not in paper["horizons"][1]
    assert attentive["horizons"][1]["half_width_n"]["mean"] == pytest.approx(1.5)
    assert 0 <= attentive["horizons"][1]["coverage"]["mean"] <= 1
    assert "coverage" not in attentive["horizons"][0]


def test_the_noise_floor_runs_from_rest_and_is_scored_on_the_same_segments():
    fin = AnalyticFin(noise_n=0.0)
    from softfin.surrogate.compare.scores import run_from_rest

    own = run_from_rest(fin, LOGS, jax.random.key(0))
    logs = [
        Log(log.command, Reading(*map(np.asarray, reading)))
        for log, reading in zip(LOGS, own, strict=True)
    ]
    comparison = compare_surrogates([candidate(0)], logs, CONFIG, noise_floor=("fin", fin))
    floor = comparison.summary["noise_floor"]
    assert floor["name"] == "second recording (fin)"
    assert [row["force_x_rmse_n"]["mean"] for row in floor["horizons"]] == [0.0, 0.0]
    assert [row["angle_rmse_rad"]["mean"] for row in floor["horizons"]] == [0.0, 0.0]
    assert compare_surrogates([candidate(0)], logs, CONFIG).summary["noise_floor"] is None


def test_few_seeds_and_commands_beyond_training_are_noted():
    few, floor = compared().summary["notes"]
    assert few == "attentive: 1 seed; fit at least 3 before you trust a difference"
    assert floor.startswith("second recording (fin): contains its own noise and drift")
    angle = LOGS[0].command.angle.copy()
    angle[:28] = 2.1
    beyond = [LOGS[0]._replace(command=LOGS[0].command._replace(angle=angle)), LOGS[1]]
    # 28 of 1120 rows; 0.6 rad beyond a range of 3 rad.
    assert beyond_limits([candidate(0)], beyond) == pytest.approx((28 / 1120, 0.2), rel=1e-4)
    notes = compare_surrogates([candidate(0), candidate(1)], beyond, CONFIG).summary["notes"]
    assert notes[0].startswith("paper: 2 seeds; fit at least 3")
    assert "2.5% of the test commands are outside" in notes[1]
    assert "by up to 20% of that range" in notes[1]


def test_logs_shorter_than_the_longest_horizon_are_refused():
    with pytest.raises(
        LogError,
        match=r"test log 0: 560 rows; the warm-up of 12 rows and a horizon of 5.5 s need 562",
    ):
        compare_surrogates([candidate(0)], LOGS, CompareConfig(horizons_s=(1, 5.5)))


@pytest.mark.parametrize(
    ("horizons", "words"),
    [
        ((), "at least 0.1 s"),
        ((1, 0), "at least 0.1 s"),
        ((-1,), "at least 0.1 s"),
        ((1.005,), "multiples of 10 ms"),
    ],
)
def test_horizons_that_mean_nothing_are_refused(horizons, words):
    with pytest.raises(ConfigurationError, match=words):
        CompareConfig.build({"horizons_s": horizons})


def test_horizons_are_put_in_order():
    assert CompareConfig(horizons_s=(30, 1, 30)).horizons_s == (1.0, 30.0)


def test_progress_ends_at_the_whole():
    seen = []
    compare_surrogates(
        [candidate(0)],
        LOGS,
        CONFIG,
        ("fin", AnalyticFin()),
        lambda stage, done, note: seen.append((done, note)),
    )
    assert [note for _, note in seen] == ["a-0, 1 s", "a-0, 2.5 s", "second recording (fin)"]
    assert [done for done, _ in seen] == pytest.approx([1 / 3, 2 / 3, 1])
