import json
import shlex
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pytest

from softfin.cli import main
from softfin.data.recordings import open_logs
from softfin.storage.dataset import Dataset, write_dataset
from tests.data.faulty import tank_logs, to_columns
from tests.surrogate.streaming import small

COLUMNS = (
    "angle=position,command_angle=command angle,command_velocity=command "
    "velocity,force_x=force x,force_y=force y"
)


@pytest.fixture(scope="module")
def authors(tmp_path_factory):
    """As the paper's authors lay theirs out: logs end to end without a time, test sets beside; here
    in degrees."""
    path = tmp_path_factory.mktemp("authors")
    logs = [to_columns(log) for log in tank_logs(3)]

    def write(name, parts):
        joined = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
        table = {
            "command angle": np.degrees(joined["command_angle_rad"]),
            "command velocity": np.degrees(joined["command_velocity_rad_s"]),
            "position": np.degrees(joined["angle_rad"]),
            "force x": joined["force_y_n"],
            "force y": joined["force_x_n"],
        }
        pyarrow.csv.write_csv(pa.table(table), path / name)

    write("final_dataset.csv", logs[:2])
    write("test_1.csv", logs[2:])
    return path


def softfin(*words) -> int:
    try:
        main([str(word) for word in words])
    except SystemExit as stop:
        return int(stop.code or 0)
    return 0


def options(*more):
    return ["--columns", COLUMNS, "--rate", "100", "--rows-per-log", "6000", *more]


def test_inspect_says_what_is_wrong_and_how_to_get_out_of_it(authors, capsys):
    assert softfin("inspect", authors, *options()) == 0
    text = capsys.readouterr().out
    assert "2 + 1 logs, 18,000 rows at 100 Hz, 3.0 minutes" in text
    assert "degrees, not rad" in text
    assert "-> --angles deg" in text
    assert "-> --force=y,x" in text
    assert text.splitlines()[-1].endswith("unless you add --ignore-errors degrees,force-axes")


def test_the_last_line_of_inspect_is_a_command_with_its_options(authors, tmp_path, capsys):
    words = options("--angles", "deg", "--force=y,x", "--ignore-errors", "degrees,force-lag")
    assert softfin("inspect", authors, *words) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    command = shlex.split(last.partition("softfin ")[2])
    assert command[:2] == ["fit", str(authors)]
    assert command[-2:] == ["--out", "surrogate"]
    command[0] = "import-logs"
    command[-1] = str(tmp_path / "d")
    assert softfin(*command) == 0
    saved = Dataset.open(tmp_path / "d").description["options"]
    assert saved["columns"]["angle"] == "position"
    assert saved["ignore_errors"] == ["degrees", "force-lag"]


def test_options_that_inspect_saves_need_not_be_typed_again(authors, tmp_path):
    logs = tmp_path / "logs"
    shutil.copytree(authors, logs)
    assert softfin("inspect", logs, *options("--angles", "deg", "--force=y,x", "--save")) == 0
    assert softfin("import-logs", logs, "--out", tmp_path / "d") == 0
    expected = options("--angles", "deg", "--force=y,x", "--out", tmp_path / "e")
    assert softfin("import-logs", authors, *expected) == 0
    found, wanted = (Dataset.open(tmp_path / name).description["options"] for name in "de")
    assert found == wanted


def test_inspect_writes_json_and_a_figure(authors, tmp_path, capsys):
    assert softfin("inspect", authors, *options("--json", "--out", tmp_path / "i")) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "i" / "inspection.json").read_text())
    assert {one["name"] for one in printed["issues"]} == {
        "degrees",
        "force axes",
        "columns",
        "force unit",
        "velocity derived",
    }
    assert printed["options"]["rows_per_log"] == 6000
    assert softfin("inspect", authors, *options("--out", tmp_path / "i")) == 2
    assert softfin("inspect", authors, *options("--out", tmp_path / "i", "--overwrite")) == 0


def test_what_cannot_be_read_is_exit_code_2_in_one_line(authors, tmp_path, capsys):
    assert softfin("inspect", authors) == 2
    assert "no column recognized as time" in capsys.readouterr().err
    assert softfin("inspect", authors, "--rate", "100", "--columns", "angle=-") == 2
    assert "no column recognized as angle" in capsys.readouterr().err
    assert softfin("inspect", tmp_path / "nowhere") == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_import_refuses_errors_and_writes_nothing(authors, tmp_path, capsys):
    assert softfin("import-logs", authors, *options("--out", tmp_path / "d")) == 2
    message = capsys.readouterr().err.splitlines()[-1]
    assert "degrees, not rad; --angles deg; 1 more error (" in message
    assert list(tmp_path.iterdir()) == []


def test_import_takes_them_as_they_are_when_errors_are_ignored(authors, tmp_path):
    words = options("--out", tmp_path / "d", "--ignore-errors", "degrees,force-axes")
    assert softfin("import-logs", authors, *words) == 0
    data = Dataset.open(tmp_path / "d")
    (log,) = data.load(data.test)
    assert np.abs(log.reading.angle).max() > 10
    assert data.description["options"]["ignore_errors"] == ["degrees", "force-axes"]
    assert data.description["issues"][0]["name"] == "degrees"


def test_import_writes_a_dataset_that_says_what_was_done(authors, tmp_path, capsys):
    right = options("--angles", "deg", "--force", "y,x", "--out", tmp_path / "d")
    assert softfin("import-logs", authors, *right) == 0
    printed = capsys.readouterr().out
    assert "final_dataset.csv: command_angle='command angle' in deg, " in printed
    assert "2 + 1 logs, 18,000 rows; 0 errors, 1 warning, 2 notes" in printed
    data = Dataset.open(tmp_path / "d")
    log, _ = data.load(data.train)
    original = tank_logs()[0]
    np.testing.assert_allclose(log.reading.angle, original.reading.angle, atol=1e-5)
    np.testing.assert_allclose(log.reading.force, original.reading.force, atol=1e-5)
    np.testing.assert_allclose(log.command.velocity, original.command.velocity, atol=1e-4)
    assert data.description["imported_from"]["files"] == ["final_dataset.csv", "test_1.csv"]
    assert data.description["options"]["force"] == "y,x"
    assert data.description["logs"][1]["log"] == "final_dataset.csv rows 6000..11999"
    assert softfin("inspect", tmp_path / "d") == 0
    assert "0 errors, 0 warnings, 0 notes" in capsys.readouterr().out
    assert softfin("import-logs", authors, *right) == 2
    assert "already exists" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["test_1.csv", "."])
def test_logs_to_score_on_alone_are_inspected_but_not_learnt_from(authors, tmp_path, capsys, name):
    (tmp_path / "test_1.csv").write_bytes((authors / "test_1.csv").read_bytes())
    logs = tmp_path / name
    right = options("--angles", "deg", "--force", "y,x")
    assert softfin("inspect", logs, *right, "--out", tmp_path / ".inspection") == 0
    assert "0 + 1 logs, 6,000 rows" in capsys.readouterr().out
    for command in ("import-logs", "fit"):
        assert softfin(command, logs, *right, "--out", tmp_path / ".out") == 2
        assert "no training logs, only 1 test log; change --test" in capsys.readouterr().err


def test_an_unknown_unit_of_angles_is_told_the_known_ones(authors, capsys):
    assert softfin("inspect", authors, *options("--angles", "degrees")) == 2
    assert (
        "'degrees' is not a unit of command_angle; must be one of rad, mrad, deg, turn"
        in capsys.readouterr().err
    )
    assert softfin("inspect", authors, *options("--angles", "angle=degrees")) == 2
    assert (
        "'degrees' is not a unit of angle; must be one of rad, mrad, deg, turn"
        in capsys.readouterr().err
    )


def test_a_frame_that_begins_with_a_minus_is_taken_as_it_is_printed(authors, capsys):
    assert softfin("inspect", authors, *options("--angles", "deg", "--force=-x,y")) == 0
    assert "-> --force=y,x" in capsys.readouterr().out


def test_options_saved_beside_a_dataset_are_used(tmp_path, capsys):
    logs = [small.recorded(300, seed) for seed in range(2)]
    write_dataset(tmp_path / "data", logs, [], {})
    assert softfin("inspect", tmp_path / "data", "--ignore-errors", "stuck", "--save") == 0
    assert open_logs(tmp_path / "data").config.ignore_errors == ("stuck",)


@pytest.mark.parametrize("rows", [5, 60])
def test_logs_of_less_than_a_second_can_be_inspected(tmp_path, rows):
    write_dataset(tmp_path / "data", [small.recorded(rows, 0)], [], {})
    assert softfin("inspect", tmp_path / "data") == 0


def test_a_folder_may_begin_like_an_option(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_dataset(tmp_path / "-logs", [small.recorded(300, seed) for seed in range(2)], [], {})
    assert softfin("inspect", "--", "-logs") == 0
    assert "next: softfin fit ./-logs " in capsys.readouterr().out


def test_a_name_of_an_error_that_is_not_there_is_noted(tmp_path, capsys):
    write_dataset(tmp_path / "data", [small.recorded(300, seed) for seed in range(2)], [], {})
    assert softfin("inspect", tmp_path / "data", "--ignore-errors", "stuk") == 0
    assert "--ignore-errors stuk: these logs have no such issue" in capsys.readouterr().out
