"""Messages about the estimates of the feedback."""

from collections.abc import Iterator

import numpy as np

from softfin.control.controller import Controller
from softfin.control.feedback import UNFAMILIAR, Estimate, Feedback

FAR = 4.0
"""Estimated drift, relative to its configured standard deviation, above which the sensor should be
zeroed [-]."""

UNFAMILIAR_NOTE = (
    "feedback: the fin does not behave like any fin in its family, so feedback relies on the mean "
    "force; check for damage, weed, a blocked shaft or a loose sensor"
)

NO_FAMILY_NOTE = (
    "feedback: no family, so a changed fin and a drifting sensor cannot be told apart; for gaits, "
    "run softfin family CONTROLLER"
)


class FeedbackNotes:
    """Messages of a run; each appears once, until its cause has gone."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._told: set[str] = set()

    def on(self, estimate: Estimate) -> Iterator[str]:
        """Yield the new messages after an action."""
        assert isinstance(self._controller, Feedback)
        drift_n = float(np.abs(np.asarray(estimate.drift)).max())
        usual_n = self._controller.config.drift_n
        has_family = self._controller.family is not None
        causes = {
            NO_FAMILY_NOTE: not has_family,
            UNFAMILIAR_NOTE: float(estimate.level) > UNFAMILIAR,
            _drift_note(usual_n): has_family and drift_n > FAR * usual_n > 0,
        }
        for note, holds in causes.items():
            if holds and note not in self._told:
                yield note
        self._told = {note for note, holds in causes.items() if holds}


def _drift_note(drift_n: float) -> str:
    return (
        f"feedback: the force sensor has drifted or jumped by more than {FAR * drift_n:.2g} N, "
        "which feedback does not correct; check its mount, stop the run, and with the fin at rest "
        "in the water, run: softfin rig zero --force"
    )
