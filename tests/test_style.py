"""The measure of style finds what it is there to find."""

from pathlib import Path

import pytest
from tools import style

CODE = '''"""A module."""

MOST_ROWS = 3
"""Rows."""


def rows_of(values: list[Any]) -> Any:
    # Why.
    first, second = values[0], [x for x in values]
    a, b = second  # fmt: skip
    return first, a, b
'''


@pytest.fixture
def figures(tmp_path: Path) -> dict[str, float]:
    (tmp_path / "module.py").write_text(CODE)
    return {figure.name: figure.value for figure in style.measure(tmp_path)}


def test_each_thing_is_counted_once(figures: dict[str, float]) -> None:
    assert figures["tuples assigned to tuples"] == 1
    assert figures["fmt: skip"] == 1
    assert figures["constants called MOST_, LEAST_ and the like"] == 1
    assert figures["functions called *_of"] == 1
    assert figures["annotations with Any"] == 1
    assert figures["comprehensions per 1,000 lines"] == 1000 / 5
    assert figures["lines with a comment [%]"] == pytest.approx(100 * 2 / 11)


def test_line_breaks_do_not_change_the_size(tmp_path: Path, figures: dict[str, float]) -> None:
    other = tmp_path / "other"
    other.mkdir()
    (other / "module.py").write_text(CODE.replace("values[0], [x", "(\n    values[0]\n), [x"))
    sizes = {figure.name: figure.value for figure in style.measure(other)}
    assert sizes["syntax nodes"] == figures["syntax nodes"]


def test_an_exceeded_limit_is_the_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "module.py").write_text(CODE)
    figures = style.measure(tmp_path)
    monkeypatch.setattr(style, "measure", lambda: figures)
    assert style.main() == 1
    assert "tuples assigned to tuples" in capsys.readouterr().out
    assert style.main() == 1
