"""Controllers of every kind as arguments of compiled programs."""

from pathlib import Path

import jax
import numpy as np
import pytest

from softfin.control.feedback import Feedback
from softfin.control.pytrees import register_controllers
from softfin.control.store import load_controller
from tests.control.folders import KINDS, folder_option


@pytest.mark.parametrize("kind", KINDS)
def test_controllers_are_pytrees(kind: str, tmp_path: Path) -> None:
    register_controllers()
    loaded = load_controller(folder_option(kind, tmp_path))
    for controller in (loaded, Feedback(loaded)):
        leaves = jax.tree.leaves(controller)
        assert leaves
        assert all(isinstance(leaf, (np.ndarray, np.generic, float, int)) for leaf in leaves)
        again = jax.tree.map(lambda leaf: leaf, controller)
        assert type(again) is type(controller)
        assert again.cells == controller.cells
