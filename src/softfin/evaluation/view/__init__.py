"""A fin to look at: a plant is rolled and drawn, its bent shape, its force and the traces, as a film or a page."""

from softfin.evaluation.view.beating import BeatConfig
from softfin.evaluation.view.view import ViewConfig

__all__ = ["BeatConfig", "ViewConfig"]
