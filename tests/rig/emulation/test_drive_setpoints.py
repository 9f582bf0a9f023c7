"""Set-points by the bits of the controlword, as CiA 402 has them."""

from softfin.rig.emulation.drive_setpoints import Setpoints

ENABLED, NEW, AT_ONCE, RELATIVE, HALT = 0x0F, 0x10, 0x20, 0x40, 0x100


def test_a_set_point_is_taken_on_a_rising_edge_and_acknowledged_until_it_falls():
    made = Setpoints()
    assert made.control(ENABLED | NEW, ENABLED, 100, 0)
    assert made.acknowledged
    assert not made.control(ENABLED | NEW, ENABLED | NEW, 200, 0)
    assert made.goal == 100
    assert not made.control(ENABLED, ENABLED | NEW, 200, 0)
    assert not made.acknowledged


def test_a_set_point_during_a_motion_waits_for_its_end_and_no_third_is_taken():
    made = Setpoints()
    made.control(ENABLED | NEW, ENABLED, 100, 0)
    made.control(ENABLED, ENABLED | NEW, 100, 10)
    assert not made.control(ENABLED | NEW, ENABLED, 50, 20)
    made.control(ENABLED, ENABLED | NEW, 50, 30)
    assert made.acknowledged
    assert not made.control(ENABLED | NEW, ENABLED, 70, 40)
    assert (made.goal, made.waiting) == (100, 50)
    made.control(ENABLED, ENABLED | NEW, 70, 40)
    assert not made.follow_on(99)
    assert made.follow_on(100)
    assert (made.goal, made.waiting) == (50, None)
    assert not made.acknowledged


def test_a_set_point_at_once_takes_the_place_of_all_before_it():
    made = Setpoints()
    made.control(ENABLED | NEW, ENABLED, 100, 0)
    made.control(ENABLED, ENABLED | NEW, 100, 10)
    made.control(ENABLED | NEW, ENABLED, 50, 20)
    made.control(ENABLED, ENABLED | NEW, 50, 20)
    assert made.control(ENABLED | NEW | AT_ONCE, ENABLED, 70, 30)
    assert (made.goal, made.waiting) == (70, None)


def test_a_relative_set_point_counts_from_the_one_before_it_or_from_where_the_profile_stands():
    made = Setpoints()
    made.control(ENABLED | NEW | RELATIVE, ENABLED, 100, 7)
    assert made.goal == 107
    made.control(ENABLED, ENABLED | NEW, 100, 10)
    made.control(ENABLED | NEW | RELATIVE, ENABLED, -30, 20)
    assert made.waiting == 77


def test_a_halted_set_point_goes_on_when_the_halt_ends():
    made = Setpoints()
    made.control(ENABLED | NEW, ENABLED, 100, 0)
    assert not made.control(ENABLED | NEW | HALT, ENABLED | NEW, 100, 10)
    assert made.control(ENABLED | NEW, ENABLED | NEW | HALT, 100, 10)
    assert made.goal == 100
    unasked = Setpoints()
    assert not unasked.control(ENABLED, ENABLED | HALT, 100, 0)


def test_a_set_point_that_comes_during_a_halt_begins_after_it():
    made = Setpoints()
    assert not made.control(ENABLED | NEW | HALT, ENABLED | HALT, 100, 0)
    assert made.acknowledged
    assert made.control(ENABLED | NEW, ENABLED | NEW | HALT, 100, 0)
