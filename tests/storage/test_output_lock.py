"""Two processes never write to one output."""

import os

import pytest

from softfin.core.errors import ArtifactError
from softfin.core.file_lock import lock_file, unlock_file
from softfin.stages.collect import collect
from softfin.stages.controllers import map_forces, train
from softfin.stages.reproduce import reproduce
from softfin.stages.surrogates import calibrate, fit
from softfin.storage.output_lock import lock_output
from softfin.storage.run_directory import CHECKPOINT, RunDirectory

MESSAGE = rf"out: in use .*\(process {os.getpid()}\).* --out"


@lock_output
def write(out, then=lambda: None):
    out.mkdir(exist_ok=True)
    then()


@pytest.fixture
def held(tmp_path):
    """An output that is being written to."""
    descriptor = lock_file(tmp_path / ".out.lock")
    yield tmp_path / "out"
    unlock_file(descriptor)


@pytest.mark.parametrize("options", [{}, {"resume": True}, {"overwrite": True}])
@pytest.mark.parametrize(
    ("stage", "given"), [(train, ["missing"]), (fit, ["a"]), (calibrate, ["a"]), (reproduce, [])]
)
def test_a_second_run_is_refused_and_the_first_one_keeps_its_work(held, stage, given, options):
    checkpoint = held.with_name(".out.unfinished") / CHECKPOINT
    checkpoint.parent.mkdir()
    checkpoint.write_text("of the first run")
    with pytest.raises(ArtifactError, match=MESSAGE):
        stage(*given, out=held, **options)
    assert checkpoint.read_text() == "of the first run"


@pytest.mark.parametrize(("stage", "given"), [(collect, []), (map_forces, ["missing"])])
def test_a_second_stage_is_refused(held, stage, given):
    with pytest.raises(ArtifactError, match=MESSAGE):
        stage(*given, out=held)


def test_a_link_to_the_output_is_the_same_output(held):
    held.mkdir()
    link = held.with_name("link")
    link.symlink_to(held)
    with pytest.raises(ArtifactError, match=MESSAGE):
        write(link)


def test_the_output_is_locked_during_the_run_and_no_lock_file_remains(tmp_path):
    out = tmp_path / "new" / "out"

    def write_again():
        with pytest.raises(ArtifactError, match=MESSAGE):
            write(out)

    write(out, write_again)
    write(out)
    assert list(out.parent.iterdir()) == [out]


def test_a_run_that_fails_leaves_no_lock(tmp_path):
    def fail():
        raise ArtifactError("no such log")

    with pytest.raises(ArtifactError, match="no such log"):
        write(tmp_path / "out", fail)
    write(tmp_path / "out")


def test_a_run_that_fails_leaves_no_empty_folder(tmp_path):
    out = tmp_path / "new" / "folder" / "out"

    @lock_output
    def fail(out):
        raise ArtifactError("no such log")

    with pytest.raises(ArtifactError, match="no such log"):
        fail(out)
    assert list(tmp_path.iterdir()) == []


def test_unfinished_work_is_next_to_the_lock_also_through_a_link(tmp_path):
    (tmp_path / "disk").mkdir()
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "disk" / "out")
    assert RunDirectory(link, {}).folder == tmp_path / "disk" / ".out.unfinished"


def test_a_run_works_if_its_output_cannot_be_locked(tmp_path):
    # No user can open a folder for writing.
    (tmp_path / ".out.lock").mkdir()
    write(tmp_path / "out")
    assert (tmp_path / "out").is_dir()


def test_a_lock_file_left_by_a_killed_process_does_not_block_a_run(tmp_path):
    (tmp_path / ".out.lock").write_text("1\n")
    write(tmp_path / "out")
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]
