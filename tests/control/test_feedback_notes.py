"""Messages about the estimates of the feedback."""

import numpy as np

from softfin.control.feedback import Estimate, Feedback
from softfin.control.feedback_notes import NO_FAMILY_NOTE, UNFAMILIAR_NOTE, FeedbackNotes
from tests.control.test_feedback import FAMILY, Carrier


def estimate(drift_n: float = 0.0, level: float = 1.0) -> Estimate:
    return Estimate(np.ones(2), np.full(2, 0.1), np.array([0.0, -drift_n]), level)


def test_a_message_appears_once_until_its_cause_has_gone() -> None:
    notes = FeedbackNotes(Feedback(Carrier(), family=FAMILY))
    assert list(notes.on(estimate())) == []
    assert list(notes.on(estimate(level=4.5))) == [UNFAMILIAR_NOTE]
    assert list(notes.on(estimate(level=4.5))) == []
    assert list(notes.on(estimate())) == []
    assert list(notes.on(estimate(level=4.5))) == [UNFAMILIAR_NOTE]


def test_a_sensor_far_from_its_zero_is_told() -> None:
    notes = FeedbackNotes(Feedback(Carrier(), family=FAMILY))
    (note,) = notes.on(estimate(drift_n=0.3))
    assert "drifted or jumped by more than 0.2 N" in note
    assert list(notes.on(estimate(drift_n=0.3))) == []


def test_without_a_family_two_causes_cannot_be_told_apart() -> None:
    notes = FeedbackNotes(Feedback(Carrier()))
    assert list(notes.on(estimate())) == [NO_FAMILY_NOTE]
    assert list(notes.on(estimate())) == []
