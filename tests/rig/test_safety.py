import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from softfin.control.controller import TrainingRange
from softfin.core.errors import ConfigurationError
from softfin.core.quantities import PAPER_LIMITS, Limits
from softfin.rig.machine import Sample, Target
from softfin.rig.safety import OVERSHOOT_RAD, Guard, SafetyConfig, check_target

LIMITS = Limits(*map(float, PAPER_LIMITS))
CURRENTS = {"current_peak_a": 4.0, "current_sustained_a": 2.0}


def guard(trained: TrainingRange | None = None, **changes: object) -> Guard:
    return Guard(SafetyConfig.build({**CURRENTS, **changes}, "safety"), LIMITS, trained)


def sample(now: float = 50.0, **changes: object) -> Sample:
    still = Sample(now - 0.002, 0.1, 0.0, 0.5, 0.01, now - 0.02, (0.5, 0.1, 0.0, 0.0, 0.0, 0.0), ())
    return still._replace(**changes)


def first(watched: Guard, seconds: float, make) -> tuple[float, object]:
    """The time of the first trip, and the trip."""
    for tick in range(round(seconds * 100)):
        now = 50 + tick / 100
        trip = watched.check(make(now), now)
        if trip is not None:
            return now - 50, trip
    return seconds, None


def test_nothing_is_wrong_with_a_fin_that_is_well():
    assert first(guard(), 3, sample)[1] is None
    assert check_target(Target(1.5, 3.0), LIMITS) is None


@pytest.mark.parametrize(
    ("changes", "cause", "figures"),
    [
        ({"complaints": ("drive fault 0x8611, following error: look",)}, "device", ("0x8611",)),
        ({"angle": 1.8}, "angle", ("1.800", "1.721", "softfin rig zero --arm")),
        ({"angle": -1.8}, "angle", ("-1.800",)),
        ({"velocity": 10.5}, "velocity", ("10.50", "10", "gear")),
        ({"velocity": -10.5}, "velocity", ("-10.50",)),
        ({"wrench": (0.0, 31.0, 0.0, 0.0, 0.0, 0.0)}, "force_peak", ("31.00", "30 N")),
        ({"wrench": (0.0, 0.0, -31.0, 0.0, 0.0, 0.0)}, "force_peak", ("31.00",)),
        ({"peak": (0.0, 31.0, 0.0, 0.0, 0.0, 0.0)}, "force_peak", ("31.00", "30 N")),
        ({"peak": (0.0, 0.0, 0.0, 0.0, 0.0, 5.5)}, "torque_peak", ("5.50", "5 N m")),
        ({"peak": (float("nan"), 0.0, 0.0, 0.0, 0.0, 0.0)}, "reading", ("finite",)),
        ({"voltage": float("nan")}, "reading", ("finite",)),
        ({"wrench": (0.0, 0.0, 0.0, 0.0, -5.1, 0.0)}, "torque_peak", ("5.10", "5 N m")),
        ({"current": -4.1}, "current_peak", ("4.10", "4 A")),
        ({"time": 49.9}, "angle_stale", ("100 ms", "50 ms", "cable")),
        ({"force_time": 49.8}, "force_stale", ("200 ms", "150 ms", "network")),
    ],
)
def test_what_is_beyond_a_limit_trips_at_once_with_figures_and_the_way_out(changes, cause, figures):
    trip = guard().check(sample(**changes), 50.0)
    assert trip.cause == cause
    assert "\n" not in trip.reason
    for figure in figures:
        assert figure in trip.reason


@pytest.mark.parametrize("end_rad", [LIMITS.angle_min, LIMITS.angle_max])
def test_a_fin_may_overshoot_either_end_of_its_range_by_the_margin_and_no_further(end_rad):
    outwards = math.copysign(1, end_rad)
    inside = end_rad + outwards * (OVERSHOOT_RAD - 0.01)
    outside = end_rad + outwards * (OVERSHOOT_RAD + 0.01)
    assert guard().check(sample(angle=inside), 50.0) is None
    assert guard().check(sample(angle=outside), 50.0).cause == "angle"


NUMBERS = ("time", "angle", "velocity", "current", "following_error", "force_time")


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", [*NUMBERS, *range(6)])
def test_a_reading_that_is_no_number_trips(name, value):
    changes = {name: value}
    if isinstance(name, int):
        wrench = [0.0] * 6
        wrench[name] = value
        changes = {"wrench": tuple(wrench)}
    assert guard().check(sample(**changes), 50.0).cause == "reading"


def test_a_tick_that_comes_too_late_trips():
    assert guard().check(sample(), 50.0, late=0.049) is None
    trip = guard().check(sample(), 50.0, late=0.062)
    assert trip.cause == "overrun"
    assert "62 ms late, but at most 50 ms is allowed (safety.overrun_s)" in trip.reason


@pytest.mark.parametrize(
    ("changes", "cause"),
    [
        ({"wrench": (12.0, 12.0, 0.0, 0.0, 0.0, 0.0)}, "force_sustained"),
        ({"wrench": (-20.0, 0.0, 0.0, 0.0, 0.0, 0.0)}, "force_sustained"),
        ({"wrench": (0.0, 20.0, 0.0, 0.0, 0.0, 0.0)}, "force_sustained"),
        ({"wrench": (0.0, 0.0, 20.0, 0.0, 0.0, 0.0)}, "force_sustained"),
        ({"wrench": (0.0, 0.0, 0.0, 3.1, 0.0, 0.0)}, "torque_sustained"),
        ({"wrench": (0.0, 0.0, 0.0, 0.0, -3.1, 0.0)}, "torque_sustained"),
        ({"wrench": (0.0, 0.0, 0.0, 0.0, 0.0, 3.1)}, "torque_sustained"),
        ({"current": 2.1}, "current_sustained"),
    ],
)
def test_a_load_below_the_peak_trips_once_it_has_lasted(changes, cause):
    after, trip = first(guard(), 2, lambda now: sample(now, **changes))
    assert trip.cause == cause
    assert after == pytest.approx(0.5, abs=0.02)


def test_force_and_torque_are_judged_apart():
    """Each just within its own limits, whatever the other one is."""
    loaded = {"wrench": (14.9, 0.0, 0.0, 2.9, 0.0, 0.0)}
    assert first(guard(), 2, lambda now: sample(now, **loaded))[1] is None
    weak = guard(force_peak_n=2.0, force_sustained_n=1.0)
    assert weak.check(sample(wrench=(0.5, 0.0, 0.0, 4.9, 4.9, 4.9)), 50.0) is None


def test_a_load_that_comes_and_goes_does_not_trip():
    def beating(now):
        return sample(now, wrench=(20.0 if int(now * 10) % 2 else 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))

    assert first(guard(), 4, beating)[1] is None


def test_an_unknown_current_is_not_judged():
    assert first(guard(), 2, lambda now: sample(now, current=None, following_error=None))[1] is None


def test_a_following_error_trips_when_it_lasts_and_not_when_it_passes():
    after, trip = first(guard(), 2, lambda now: sample(now, following_error=-0.4))
    assert trip.cause == "following"
    assert "-0.400 rad" in trip.reason
    assert after == pytest.approx(0.11, abs=0.02)
    passing = first(
        guard(), 2, lambda now: sample(now, following_error=0.4 if int(now * 20) % 2 else 0.1)
    )
    assert passing[1] is None


def test_a_velocity_that_changes_faster_than_any_drive_trips():
    after, trip = first(guard(), 1, lambda now: sample(now, velocity=0.0 if now < 50.5 else 8.0))
    assert trip.cause == "acceleration"
    assert after == pytest.approx(0.5, abs=0.03)
    assert (
        first(guard(), 1, lambda now: sample(now, velocity=min(4.0, 100 * (now - 50))))[1] is None
    )


@pytest.mark.parametrize(("velocity", "cause"), [(5.9, None), (6.1, "acceleration")])
def test_the_first_change_of_velocity_is_judged_over_thirty_milliseconds(velocity, cause):
    """A jump of 5.9 rad/s is 197 rad/s2 over 30 ms, and 295 over the 20 ms of the first three
    readings."""
    trip = first(
        guard(), 0.05, lambda now: sample(now, velocity=0.0 if now < 50.005 else velocity)
    )[1]
    assert (trip and trip.cause) == cause


def test_the_same_reading_twice_is_no_acceleration():
    watched = guard(stale_s=1.0, force_stale_s=1.0)
    for tick in range(10):
        assert (
            watched.check(sample(50.0, velocity=5.0 if tick < 5 else 5.1), 50.0 + tick / 100)
            is None
        )


def test_far_beyond_the_training_range_trips_after_a_second():
    trained = TrainingRange((-1.0, 1.0), (-3.0, 3.0), (-2.0, 2.0), None)
    far = guard(trained)
    after, trip = first(far, 3, lambda now: sample(now, wrench=(5.0, 0.0, 0.0, 0.0, 0.0, 0.0)))
    assert trip.cause == "beyond_training"
    assert (
        "force x was outside the training range of the surrogate by 0.75 of its width"
        in trip.reason
    )
    assert after == pytest.approx(1.0, abs=0.03)
    assert (
        first(guard(trained), 3, lambda now: sample(now, wrench=(3.0, 0.0, 0.0, 0.0, 0.0, 0.0)))[1]
        is None
    )
    unlooked = guard(trained, training_margin=None)
    assert (
        first(unlooked, 3, lambda now: sample(now, wrench=(9.0, 0.0, 0.0, 0.0, 0.0, 0.0)))[1]
        is None
    )


@given(st.floats(), st.floats())
def test_a_target_passes_only_inside_the_limits(angle, velocity):
    trip = check_target(Target(angle, velocity), LIMITS)
    inside = (
        LIMITS.angle_min - 1e-3 <= angle <= LIMITS.angle_max + 1e-3
        and LIMITS.velocity_min - 1e-3 <= velocity <= LIMITS.velocity_max + 1e-3
    )
    assert (trip is None) == inside
    if trip is not None:
        assert trip.cause in ("not_a_number", "command_angle", "command_velocity")
        assert "\n" not in trip.reason


@given(
    st.builds(
        Sample,
        *[st.floats()] * 3,
        st.none() | st.floats(),
        st.none() | st.floats(),
        st.floats(),
        st.tuples(*[st.floats()] * 6),
        st.just(()),
    ),
    st.floats(0, 1),
)
def test_whatever_is_read_is_judged_in_one_line_or_is_well(read, late):
    trip = guard().check(read, 50.0, late)
    if trip is None:
        assert all(
            map(
                math.isfinite, (read.time, read.angle, read.velocity, read.force_time, *read.wrench)
            )
        )
        assert abs(read.velocity) <= 10
        assert max(map(abs, read.wrench[:3])) <= 30
        assert late <= 0.05
    else:
        assert "\n" not in trip.reason


def test_a_time_that_lies_ahead_is_not_taken_for_fresh():
    assert guard().check(sample(time=60.0), 50.0).cause == "angle_stale"
    assert guard().check(sample(force_time=60.0), 50.0).cause == "force_stale"


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"force_peak_n": 5.0}, "force_sustained_n = 15.0 with force_peak_n = 5.0"),
        ({"current_peak_a": 5.0}, "current_sustained_a = None"),
        ({"force_peek_n": 5.0}, "force_peak_n"),
        ({"overrun_s": 2.0}, "overrun_s"),
    ],
)
def test_a_configuration_that_makes_no_sense_is_refused(values, words):
    with pytest.raises(ConfigurationError, match=words):
        SafetyConfig.build(values, "safety")


def test_a_following_error_before_a_restart_is_not_one_that_lasts_after_it():
    watched = guard()
    assert watched.check(sample(50.0, following_error=0.4), 50.0) is None
    watched.restart()
    assert watched.check(sample(60.0, following_error=0.4), 60.0) is None
    assert watched.check(sample(60.2, following_error=0.4), 60.2).cause == "following"
