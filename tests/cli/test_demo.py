"""``softfin demo`` is the reproduction of small size on the virtual tank."""

from pathlib import Path
from typing import Any

import pytest

from softfin.cli import main
from softfin.core.errors import LogError
from softfin.stages.reproduce_config import PRESETS


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, Any]:
    """What the stage was called with, in place of the run."""
    found: dict[str, Any] = {}

    def reproduce(plant: str, out: Path, config: Any, **options: Any) -> None:
        found.update(plant=plant, out=out, config=config, **options)
        raise LogError("enough")

    monkeypatch.setattr("softfin.stages.reproduce.reproduce", reproduce)
    monkeypatch.chdir(tmp_path)
    return found


@pytest.mark.parametrize(
    ("words", "preset", "out"),
    [
        (("demo",), "demo", "runs/demo"),
        (("demo", "--quick", "--out", "quick", "--seed", "3"), "tiny", "quick"),
        (("reproduce", "--out", "run", "--resume"), "paper", "run"),
    ],
)
def test_the_preset_is_the_one_of_the_command(
    asked: dict[str, Any], words: tuple[str, ...], preset: str, out: str
) -> None:
    with pytest.raises(SystemExit):
        main(words)
    assert asked["plant"] == "tank"
    assert asked["out"] == Path(out)
    assert asked["config"] == PRESETS[preset]
    assert asked["seed"] == (3 if "--seed" in words else 0)
    assert asked["resume"] == ("--resume" in words)


@pytest.mark.parametrize(("command", "printed"), [("demo", False), ("reproduce", True)])
def test_only_reproduce_prints_what_the_paper_measured(
    command: str,
    printed: bool,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    parts = ("surrogate", "controllers", "trimmed", "in_surrogate")
    results = {**dict.fromkeys(parts), "stages": [], "wall_s": {}, "peak_memory_gib": 0.0}
    monkeypatch.setattr("softfin.stages.reproduce.reproduce", lambda *given, **options: results)
    main((command, "--out", str(tmp_path / "run")))
    text = capsys.readouterr().out
    assert ("grid, mean" in text) == printed
    assert ("measured on the real fin; do not compare" in text) == printed
