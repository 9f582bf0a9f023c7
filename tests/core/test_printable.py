import pytest

from softfin.core.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("fin 3, µN, 水", "fin 3, µN, 水"),
        ("a\x1b[2Jb\n", r"a\x1b[2Jb\n"),
        # One letter that many terminals take for ESC [.
        ("a\x9b2Jb", r"a\x9b2Jb"),
        ("a\rb\x08\x07\x7f", r"a\rb\x08\x07\x7f"),
        ("a\u202eb", r"a\u202eb"),
        ("a\udcff", r"a\udcff"),
    ],
)
def test_what_steers_a_terminal_is_shown_as_an_escape(text, shown):
    assert printable(text) == shown
    assert printable(text).isprintable()


def test_ends_of_lines_stay_where_they_are_kept():
    assert printable("a\nb\x1b", "\n") == "a\nb\\x1b"


def test_a_text_is_cut_where_it_is_longer_than_asked():
    assert printable("x" * 300, most=300) == "x" * 300
    assert printable("x" * 301, most=300) == "x" * 298 + " …"
    assert len(printable("\x1b" * 300, most=300)) == 300
