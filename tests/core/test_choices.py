"""Each list of names has one definition, and what the names stand for covers it."""

import ast
from pathlib import Path
from typing import Any, get_args

import pytest

import softfin.cli
from softfin.core import choices
from softfin.data.importing.names import UNITS
from softfin.learning.configuration import TRAIN_PRESETS
from softfin.stages.reproduce import PRESETS as REPRODUCTIONS
from softfin.tank.calibration.config import CALIBRATE_PRESETS as CALIBRATIONS

COMMAND_LINE = Path(softfin.cli.__file__).parent


@pytest.mark.parametrize(
    ("names", "table"),
    [
        (choices.ReproducePreset, REPRODUCTIONS),
        (choices.CalibratePreset, CALIBRATIONS),
        (choices.TimeUnit, UNITS["time"]),
        (choices.ForceUnit, UNITS["force"]),
        (choices.PolicyLayout, TRAIN_PRESETS),
    ],
)
def test_every_name_that_may_be_chosen_stands_for_something(names: Any, table: Any) -> None:
    assert set(get_args(names)) == set(table)


@pytest.mark.parametrize("file", sorted(COMMAND_LINE.glob("*.py")), ids=lambda file: file.stem)
def test_no_command_types_choices_of_its_own(file: Path) -> None:
    lists = [
        node
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal"
    ]
    assert len(lists) == 0
