import json

import pytest

from softfin.cli import main
from softfin.cli.surrogates import comparison_tables
from softfin.storage.dataset import write_dataset
from softfin.surrogate import save_surrogate
from tests.cli.test_cli import fails
from tests.surrogate import small


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Three seeds, a dataset with short test logs, one without."""
    root = tmp_path_factory.mktemp("compare")
    for seed in range(3):
        save_surrogate(
            root / f"s{seed}",
            small.surrogate(seed),
            None,
            {"data_hash": "d"},
            configuration={"epochs": 1},
        )
    logs = [small.log(rows=340, seed=seed) for seed in range(3)]
    write_dataset(root / "data", logs[:1], logs[1:], {})
    write_dataset(root / "untested", logs[:1], [], {})
    return root


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (
            ["s0", "s1", "s0"],
            "s0: duplicate surrogate, or a copy of another one; list each surrogate once",
        ),
        (
            ["s0", "--dataset", "untested"],
            "untested: contains no test logs; put Parquet logs into",
        ),
        (
            ["s0"],
            "test log 0: 340 rows; the warm-up of 12 rows and a horizon of 30 s need 3012; record "
            "longer test logs",
        ),
        (["s0", "--horizons", "1,,2"], "--horizons 1,,2: not a list of numbers"),
        (["s0", "--horizons", "nan"], "horizons.0 = nan"),
        (["s0", "--horizons", "0,1"], "horizons must be at least 0.1 s"),
        (
            ["s0", "--horizons", "1", "--noise-floor", "pool"],
            "plant pool: unknown (does not exist)",
        ),
    ],
)
def test_wrong_input_is_one_line_and_exit_code_2(capsys, folders, monkeypatch, words, expected):
    monkeypatch.chdir(folders)
    given = [*words, *(["--dataset", "data"] if "--dataset" not in words else [])]
    line, code = fails(capsys, "compare", *given, "--out", "x")
    assert expected in line
    assert code == 2
    assert not (folders / "x").exists()


def test_surrogates_are_compared_and_the_result_is_a_table_a_json_and_a_folder(
    capsys, folders, monkeypatch, tmp_path
):
    monkeypatch.chdir(folders)
    words = [
        "compare",
        "s0",
        "s1",
        "s2",
        "--dataset",
        "data",
        "--horizons",
        "2.5,1",
        "--noise-floor",
        "tank",
    ]
    main([*words, "--out", str(tmp_path / "x"), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["horizons_s"] == [1, 2.5]
    assert [group["seeds"] for group in result["groups"]] == [3]
    assert result["test_logs"] == 2
    assert result["noise_floor"]["name"] == "second recording (tank)"
    written = json.loads((tmp_path / "x" / "comparison.json").read_text())
    assert written == {name: value for name, value in result.items() if name != "comparison"}
    # A comparison is a folder of softfin's, so it may be replaced.
    main([*words[:2], *words[4:8], "--out", str(tmp_path / "x"), "--overwrite"])
    assert "note: paper: 1 seed; fit at least 3" in capsys.readouterr().out


def cell(mean, half=None):
    return {"mean": mean, "interval": None if half is None else [mean - half, mean + half]}


def horizon(seconds, half=None, **more):
    scores = {
        "angle_rmse_rad": 0.0123,
        "angle_mae_rad": 0.0012,
        "force_x_rmse_n": 0.203,
        "force_y_rmse_n": 0.25,
        "force_mae_n": 0.1,
        "force_x_r2": 0.99,
        "force_y_r2": -1234.5,
    }
    for quantity, unit in (("angle", "rad"), ("force", "n")):
        scores |= {f"{quantity}_dtw_mae_{unit}": 12.345, f"{quantity}_dtw_mae_scaled": 1e-7}
    return {
        "horizon_s": seconds,
        **{name: cell(value, half) for name, value in (scores | more).items()},
    }


MEANS = {f"mean_force_{name}_n": 0.05 for name in ("x_mae", "y_mae", "mae", "p95", "worst")}
GROUP = {"parameters": 12345, "flops_per_tick": 1000}
SUMMARY = {
    "test_logs": 3,
    "scored": [{"rows": 100}, {"rows": 54000}],
    "flops_ratio_to": "paper",
    "groups": [
        {
            "name": "paper",
            "seeds": 1,
            "flops_ratio": 1.0,
            **GROUP,
            "horizons": [horizon(1), horizon(30, **MEANS)],
        },
        {
            "name": "streaming",
            "seeds": 3,
            "flops_ratio": 0.1234,
            **GROUP,
            "horizons": [
                horizon(1, 0.011),
                horizon(30, 0.011, **MEANS, coverage=0.912, half_width_n=0.07),
            ],
        },
    ],
    "noise_floor": {
        "name": "second recording (tank)",
        "horizons": [horizon(1), horizon(30, **MEANS)],
    },
    "notes": ["paper: 1 seed; fit at least 3 before you trust a difference"],
}


def test_the_tables_fit_120_columns_and_no_two_cells_touch():
    text = comparison_tables(SUMMARY)
    assert max(map(len, text.splitlines())) <= 120
    row = next(line for line in text.splitlines() if line.startswith("  30 s") and "±" in line)
    assert row[8:].replace(" \N{PLUS-MINUS SIGN}", "\N{PLUS-MINUS SIGN}").split() == [
        "12.30±11.00",
        "1.200±11.000",
        "0.203±0.011",
        "0.250±0.011",
        "0.100±0.011",
        "0.990±0.011",
        "-1234±0",
    ]


def test_the_tables_say_seeds_cost_coverage_floor_and_notes():
    text = comparison_tables(SUMMARY)
    assert (
        "54,000 rows at the longest horizon; mean over the seeds ± half of its 95% interval" in text
    )
    assert "streaming: 3 seeds, 12,345 parameters, 1,000 FLOPs per tick (0.123 of paper's)" in text
    assert "paper: 1 seed, 12,345 parameters, 1,000 FLOPs per tick\n" in text
    assert "Mean force over 200 samples, with the surrogate's 90% intervals" in text
    assert "91.20 ±1.10" in text
    assert "second recording (tank)\n" in text
    assert text.endswith("note: paper: 1 seed; fit at least 3 before you trust a difference")


def test_what_no_group_has_is_left_out_of_the_comparison_tables():
    alone = {
        **SUMMARY,
        "groups": [{**SUMMARY["groups"][0], "horizons": [horizon(1)]}],
        "noise_floor": None,
        "notes": [],
    }
    text = comparison_tables(alone)
    assert "Mean force" not in text
    assert "floor" not in text
    assert "±" not in text
