import numpy as np
import pytest

from softfin.core.quantities import Command, Reading
from softfin.evaluation.experiment import Recording
from softfin.evaluation.response import responses, steps_of, tracking_error
from softfin.evaluation.scores import score
from softfin.task.signals import Ramp, Recorded, Sinusoid, Step

STEP = Step(start_n=(1, 0), to_n=(2, 0), at_s=5).sample(1500).astype(float)


def late(series, ticks):
    """The same, so much later."""
    return np.concatenate([np.repeat(series[:1], ticks, axis=0), series[: len(series) - ticks]])


def test_a_force_that_jumps_with_its_reference_is_delayed_by_the_window_alone():
    (response,) = responses(STEP, STEP)
    assert response.at_s == 5.0
    assert response.rise_s == (pytest.approx(1.6, abs=0.011), None)
    assert response.settling_s == pytest.approx(1.6, abs=0.011)
    assert response.overshoot_percent == (pytest.approx(0, abs=1e-6), None)


def test_a_late_force_settles_later_but_rises_as_fast():
    (response,) = responses(late(STEP, 100), STEP)
    assert response.rise_s[0] == pytest.approx(1.6, abs=0.011)
    assert response.settling_s == pytest.approx(2.6, abs=0.011)


def test_overshoot_is_a_part_of_the_step_whatever_its_sign_and_size():
    reference = Step(start_n=(3, 1), to_n=(1, 2), at_s=5).sample(1500).astype(float)
    force = reference.copy()
    force[500:800] += 0.25 * (reference[500] - reference[0])
    (response,) = responses(force, reference)
    np.testing.assert_allclose(response.overshoot_percent, [25, 25], atol=1e-6)


def test_settling_is_on_both_axes_and_for_good():
    force = STEP.copy()
    # For 200 samples 0.5 N off in y, long after x is there: the average leaves the band of 0.2 N and comes back.
    force[900:1100, 1] = 0.5
    (response,) = responses(force, STEP)
    assert response.settling_s == pytest.approx((1100 + 120 - 500) / 100, abs=0.011)


def test_a_step_that_is_never_reached_has_no_times():
    reference = Step(start_n=(1, 0), to_n=(2, 0), at_s=5).sample(1500).astype(float)
    (response,) = responses(np.tile([1.0, 0.0], (1500, 1)), reference)
    assert response.rise_s == (None, None)
    assert response.settling_s is None
    assert response.described()["settling_s"] is None


def test_one_step_is_judged_up_to_the_next():
    reference = Recorded(time_s=(0, 4, 9), force_n=((1, 0), (2, 0), (2, 2))).sample(1300).astype(float)
    force = reference.copy()
    force[1000:] = 7
    first, second = responses(force, reference)
    assert first.settling_s == pytest.approx(1.6, abs=0.011)
    assert (first.at_s, second.at_s, second.settling_s) == (4.0, 9.0, None)
    assert second.to.tolist() == [2, 2]


def test_only_changes_between_forces_held_for_a_window_are_steps():
    assert steps_of(Step(start_n=(1, 0), to_n=(2, 0), at_s=2).sample(400)) == [(200, 400)]
    assert steps_of(Step(start_n=(1, 0), to_n=(2, 0), at_s=1).sample(400)) == []
    assert steps_of(Ramp(start_n=(1, 0), to_n=(2, 0), begin_s=5, end_s=10).sample(1500)) == []
    assert steps_of(Sinusoid(centre_n=(1, 0), amplitude_n=(1, 1)).sample(1500)) == []


def test_the_two_tracking_errors_differ_by_the_delay_of_the_window():
    """A force that is its reference, on a ramp of 0.1 N/s: the average over 2 s is 1 s, so 0.1 N, behind it."""
    reference = Ramp(start_n=(0, 0), to_n=(2, -4), begin_s=0.01, end_s=20.01).sample(2001)[1:].astype(float)
    np.testing.assert_allclose(tracking_error(reference, reference), [0.1, 0.2], atol=2e-3)
    ticks = np.zeros((1, 1, 2000))
    recording = Recording(reference[None], Command(ticks, ticks), Reading(ticks, ticks, ticks, reference[None, None]))
    np.testing.assert_allclose(score(recording).error, 0, atol=1e-9)
    recording = recording._replace(reference=reference[None] + [0.3, 0])
    np.testing.assert_allclose(score(recording).error[0, 0], [0.3, 0], atol=1e-9)
