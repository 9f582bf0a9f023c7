import os

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq
import pytest

from softfin.core.errors import ArtifactError, ConfigurationError, LogError
from softfin.data.checks.inspection import Inspection
from softfin.data.importing.importing import ImportConfig
from softfin.data.issues import Issue
from softfin.data.recordings import OpenedLogs, find_recordings, open_logs
from softfin.storage.dataset import Dataset, write_dataset
from tests.data.bags import topics_of, write_bag
from tests.data.faulty import cut, tank_logs, to_columns, write_parquet


@pytest.fixture(scope="module")
def logs():
    return [cut(log, 0, 2000) for log in tank_logs(3)]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory, logs):
    path = tmp_path_factory.mktemp("data") / "dataset"
    write_dataset(path, logs[:2], logs[2:], {})
    return path


def folder_option(path, logs):
    path.mkdir()
    for index, log in enumerate(logs[:2]):
        pyarrow.csv.write_csv(pa.table(to_columns(log)), path / f"run{index}.csv")
    write_parquet(path / "Test_a.parquet", to_columns(logs[2]))
    write_bag(path / "test" / "bag", topics_of(to_columns(logs[2])))
    (path / "notes.md").write_text("a calm day")
    (path / ".hidden.csv").write_text("")
    return path


def test_a_dataset_opens_as_it_is_and_keeps_its_hash(dataset, logs):
    opened = open_logs(dataset)
    assert opened.inspection.issues == []
    names = ["train/0000.parquet", "train/0001.parquet", "test/000.parquet"]
    assert [one.name for one in opened.logs] == names
    assert opened.data_hash == Dataset.open(dataset).data_hash
    np.testing.assert_array_equal(opened.train[1].reading.force, logs[1].reading.force)
    assert len(opened.test) == 1


def test_a_dataset_keeps_its_channels(tmp_path, logs):
    torque = np.random.default_rng(0).normal(size=2000).astype(np.float32)
    write_dataset(tmp_path / "d", [logs[0]._replace(channels={"torque_nm": torque})], [], {})
    opened = open_logs(tmp_path / "d")
    assert {issue.name for issue in opened.inspection.issues} == {"no test logs"}
    np.testing.assert_array_equal(opened.train[0].channels["torque_nm"], torque)


def test_a_dataset_that_was_changed_is_refused_as_ever(tmp_path, logs):
    write_dataset(tmp_path / "d", logs[:1], [], {})
    write_parquet(tmp_path / "d" / "train" / "0000.parquet", to_columns(logs[1]))
    with pytest.raises(ArtifactError, match="truncated or changed"):
        open_logs(tmp_path / "d")


def test_faulty_files_put_into_a_dataset_are_issues_not_the_first_error(tmp_path, logs):
    for index, log in enumerate(logs[:2]):
        columns = to_columns(log)
        columns["force_x_n"][5 + index] = np.nan
        write_parquet(tmp_path / "train" / f"{index}.parquet", columns)
    (tmp_path / "dataset.json").write_text("{}")
    issues = open_logs(tmp_path).inspection.issues
    assert issues[0].name == "not a number"
    assert issues[0].logs == ("train/0.parquet", "train/1.parquet")


def test_a_folder_of_all_kinds_opens_as_one_set_of_logs(tmp_path, logs):
    opened = open_logs(folder_option(tmp_path / "all", logs))
    assert [(one.name, one.part) for one in opened.logs] == [
        ("Test_a.parquet", "test"),
        ("run0.csv", "train"),
        ("run1.csv", "train"),
        ("test/bag", "test"),
    ]
    assert not [one for one in opened.inspection.issues if one.severity != "note"]
    np.testing.assert_allclose(opened.train[0].reading.angle, logs[0].reading.angle, atol=1e-6)
    assert opened.metadata["imported_from"]["files"] == [one.name for one in opened.logs]
    described = {"log": "Test_a.parquet", "part": "test", "rows": 2000, "start_s": 0.01}
    assert opened.metadata["logs"][0] == described


def test_a_velocity_of_zeros_in_one_of_several_logs_stops_until_the_fix_is_given(tmp_path, logs):
    folder = folder_option(tmp_path / "logs", logs)
    columns = to_columns(logs[2])
    columns["velocity_rad_s"][:] = 0
    write_bag(folder / "joint", topics_of(columns))
    with pytest.raises(LogError, match=r"^logs: joint, .*--columns velocity=- "):
        open_logs(folder).check_issues("logs")
    opened = open_logs(folder, ImportConfig.build({"columns": "velocity=-"}))
    opened.check_issues("logs")
    assert all(np.ptp(log.reading.velocity) > 1 for log in opened.train)


def test_one_file_is_enough(tmp_path, logs):
    path = folder_option(tmp_path / "all", logs) / "run0.csv"
    assert [one.name for one in open_logs(path).logs] == ["run0.csv"]


def test_test_logs_are_chosen_by_a_pattern(tmp_path, logs):
    path = folder_option(tmp_path / "all", logs)
    opened = open_logs(path, ImportConfig(test="run1*"))
    assert [one.name for one in opened.logs if one.part == "test"] == ["run1.csv"]
    with pytest.raises(ConfigurationError, match="--test walk"):
        open_logs(path, ImportConfig(test="walk"))
    opened = open_logs(path, ImportConfig(test="*"))
    assert opened.train == []
    with pytest.raises(LogError, match=r"runs: no training logs.* --test"):
        opened.check_train("runs")


def test_the_hash_tells_files_and_options_apart(tmp_path, logs):
    path = folder_option(tmp_path / "all", logs)
    plain = open_logs(path).data_hash
    assert plain == open_logs(path).data_hash
    assert plain != open_logs(path, ImportConfig(force="x,-y")).data_hash
    (path / "run1.csv").rename(path / "run2.csv")
    assert plain != open_logs(path).data_hash


def test_files_whose_columns_are_read_in_another_way_are_each_shown(tmp_path, logs):
    for name, angle in (("a", "theta"), ("b", "theta"), ("c", "pos [rad]")):
        columns = {
            angle if own == "angle_rad" else own: each for own, each in to_columns(logs[0]).items()
        }
        write_parquet(tmp_path / f"{name}.parquet", columns)
    opened = open_logs(tmp_path)
    assert opened.inspection.summary()["columns"] == {
        "a.parquet": "angle='theta' in rad (assumed)",
        "c.parquet": "angle='pos [rad]' in rad",
    }
    assert [one.logs for one in opened.inspection.issues if one.name == "columns"] == [
        ("a.parquet", "b.parquet"),
        ("c.parquet",),
    ]


def test_pieces_that_are_all_too_short_are_refused(tmp_path, logs):
    columns = {name: values[np.r_[0:100, 150:250]] for name, values in to_columns(logs[0]).items()}
    write_parquet(tmp_path / "a.parquet", columns)
    with pytest.raises(LogError, match="--shortest 1"):
        open_logs(tmp_path)


def test_nanoseconds_since_1970_are_a_clock_too(tmp_path, logs):
    columns = to_columns(logs[0])
    columns["time_s"] = 1_700_000_000_123_456_789 + 10_000_000 * np.arange(2000)
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    (one,) = open_logs(tmp_path, ImportConfig(time_unit="ns")).logs
    np.testing.assert_allclose(one.log.reading.time, np.arange(2000) / 100, atol=1e-6)


def test_nothing_to_read_is_refused(tmp_path):
    with pytest.raises(LogError, match="contains no recordings"):
        open_logs(tmp_path)
    with pytest.raises(LogError, match="no such file or folder"):
        open_logs(tmp_path / "nowhere")


def test_errors_stop_unless_they_are_accepted_and_warnings_do_not():
    def issue(severity, name):
        message = "spans -90 .. 90: degrees"
        return Issue(severity, name, "run.csv", message, "--angles deg", "angle", 7)

    def opened(*issues, ignored=""):
        config = ImportConfig.build({"ignore_errors": ignored})
        return OpenedLogs((), Inspection(list(issues), []), "", {}, config)

    opened(issue("warning", "a"), issue("note", "b")).check_issues("runs")
    errors = [issue("error", name) for name in "abc"]
    opened(*errors, ignored="all").check_issues("runs")
    opened(*errors, ignored="c,b,a").check_issues("runs")
    with pytest.raises(LogError, match="--ignore-errors b,c "):
        opened(*errors, ignored="a").check_issues("runs")
    with pytest.raises(LogError) as error:
        opened(*errors).check_issues("runs")
    message = str(error.value)
    assert message.startswith("runs: run.csv, row 7, column angle: spans -90 .. 90: degrees; ")
    assert all(words in message for words in ("--angles deg", "2 more", "--ignore-errors a,b,c "))


def test_an_error_of_two_words_is_ignored_by_either_spelling_and_others_are_not():
    errors = [Issue("error", name, "run.csv", "") for name in ("force axes", "force lag")]
    for name in ("force axes", "force-axes"):
        config = ImportConfig.build({"ignore_errors": name})
        opened = OpenedLogs((), Inspection(errors, []), "", {}, config)
        assert [issue.name for issue in opened.remaining_errors()] == ["force lag"]
        with pytest.raises(LogError, match="--ignore-errors force-lag "):
            opened.check_issues("runs")


def test_options_saved_beside_the_logs_are_read_and_those_given_win(tmp_path, logs):
    path = folder_option(tmp_path / "all", logs)
    (path / "log.yaml").write_text("force: y,x\ncolumns:\n  angle: angle_rad\n")
    opened = open_logs(path, ImportConfig.build({"columns": "velocity=-"}))
    assert opened.config.force == "y,x"
    assert opened.config.columns == {"angle": "angle_rad", "velocity": "-"}
    assert open_logs(path, ImportConfig(force="x,y")).config.force == "x,y"
    assert open_logs(path / "run0.csv").config.force == "y,x"
    assert open_logs(path).data_hash == open_logs(path, ImportConfig(force="y,x")).data_hash
    (path / "log.yaml").write_text("forse: y,x\n")
    with pytest.raises(ConfigurationError, match=r"log\.yaml"):
        open_logs(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="without pipes in folders")
def test_pipes_broken_links_and_links_in_circles_are_no_recordings(tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "a.csv").write_text("time_s\n0\n")
    os.mkfifo(tmp_path / "logs" / "b.csv")
    (tmp_path / "logs" / "c.csv").symlink_to(tmp_path / "none")
    for name in ("d", "e"):
        (tmp_path / "logs" / name).symlink_to(tmp_path)
    assert find_recordings(tmp_path) == [tmp_path / "logs" / "a.csv"]
