"""``softfin demo`` is the reproduction of small size on the virtual tank."""

from pathlib import Path
from typing import Any

import pytest

from softfin.cli import main
from softfin.core.errors import LogError
from softfin.stages import reproduce


@pytest.mark.parametrize(
    ("words", "preset", "out"),
    [
        (("demo",), "demo", "runs/demo"),
        (("demo", "--quick", "--out", "quick", "--seed", "3"), "tiny", "quick"),
        (("reproduce", "--out", "run", "--resume"), "paper", "run"),
    ],
)
def test_the_preset_is_the_one_of_the_command(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    words: tuple[str, ...],
    preset: str,
    out: str,
) -> None:
    asked: list[Any] = []

    def claim(*given: Any) -> None:
        asked.extend(given)
        raise LogError("enough")

    monkeypatch.setattr(reproduce, "_claim", claim)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        main(words)
    assert asked == [
        Path(out),
        "tank",
        preset,
        3 if "--seed" in words else 0,
        "--resume" in words,
        False,
    ]
