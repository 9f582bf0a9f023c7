import threading

import pytest

from softfin.core.errors import CoverageError
from softfin.rig.loop import LiveReference, recorded_reference


def admit(force):
    x, y = force
    if not abs(x) <= 5:
        raise CoverageError(f"({x:g}, {y:g}) N: this controller holds -5 .. 5 N; ask for less")
    return ((x, min(y, 2.0)), "nearest is held" if y > 2 else None)


def said(first=(1.0, 1.0)):
    told = []
    return LiveReference(first, admit, told.append), told


def test_a_line_of_the_terminal_is_the_reference_from_then_on():
    references, told = said()
    assert references(0.0) == (1.0, 1.0)
    references.set_from_text("2,-1")
    assert references(1.0) == (2.0, -1.0)
    assert told == []


@pytest.mark.parametrize("line", ["hello", "1", "1,2,3", "1;2", ",", "2,x"])
def test_a_line_that_is_no_reference_is_told_and_not_taken(line):
    references, told = said()
    references.set_from_text(line)
    assert references(0.0) == (1.0, 1.0)
    assert "type X,Y in newtons, e.g. 2,-1, or press Enter to stop the fin" in told[0]


@pytest.mark.parametrize("line", ["9,0", "nan,0", "inf,0"])
def test_a_reference_that_cannot_be_held_is_told_and_not_taken(line):
    references, told = said()
    references.set_from_text(line)
    assert references(0.0) == (1.0, 1.0)
    assert told[0].endswith("ask for less; the reference is unchanged")


def test_the_nearest_is_held_with_a_warning():
    references, told = said((0.0, 3.0))
    assert references(0.0) == (0.0, 2.0)
    references.set_from_text("1,4")
    assert references(0.0) == (1.0, 2.0)
    assert told == ["nearest is held"] * 2


def test_a_first_reference_that_cannot_be_held_is_an_error():
    with pytest.raises(CoverageError):
        said((9.0, 0.0))


def test_references_from_another_thread_are_whole():
    references, _ = said((0.0, 0.0))

    def say():
        for k in range(2000):
            references.set_from_text(f"{k / 1000},{-k / 1000}")

    thread = threading.Thread(target=say)
    thread.start()
    while thread.is_alive():
        x, y = references(0.0)
        assert x == -y
    thread.join()


def test_each_row_of_a_file_holds_from_its_time_on():
    told = []
    references = recorded_reference(
        [0.0, 1.0, 2.5], [(0.0, 0.0), (1.0, 3.0), (2.0, 3.0)], admit, told.append
    )
    assert [references(at)[0] for at in (0.0, 0.99, 1.0, 2.0, 2.5, 99.0)] == [0, 0, 1, 1, 2, 2]
    assert references(1.0)[1] == 2.0
    assert told == ["nearest is held (and 1 more rows)"]


def test_a_file_with_a_row_that_cannot_be_held_is_refused_before_anything_moves():
    with pytest.raises(CoverageError):
        recorded_reference([0.0, 1.0], [(0.0, 0.0), (9.0, 0.0)], admit, print)
