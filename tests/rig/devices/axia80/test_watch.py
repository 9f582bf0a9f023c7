import pytest

from softfin.rig.devices.axia80.rdt import RdtRecord
from softfin.rig.devices.axia80.watch import StreamWatch


def watched(counts, pause_s=0.0, pause_at=None):
    """A watch that has seen a record with each of these counts of samples, one in a millisecond but
    for a pause."""
    watch = StreamWatch(1000.0)
    for place, count in enumerate(counts):
        time = 100.0 + place / 1000
        if pause_at is not None and place >= pause_at:
            time += pause_s
        watch.take(RdtRecord(place, count % 2**32, 0, (place,) * 6), time)
    return watch


def counted(start, records=500):
    return list(range(start, start + 8 * records, 8))


@pytest.mark.parametrize("start", [0, 10**6, 2**31 - 4000, 2**31 + 4000, 2**32 - 4000])
def test_a_count_that_goes_on_or_rolls_over_is_no_restart(start):
    assert not watched(range(start, start + 8000, 8)).has_restarted


@pytest.mark.parametrize("before", [10_000, 10**9, 2**31 + 10**6, 2**32 - 10**6])
def test_a_count_that_begins_anew_is_a_restart(before):
    watch = watched([*counted(before), 0, 8])
    assert watch.has_restarted
    assert (
        "its zero is lost; let the fin rest and run: softfin rig zero --force" in watch.lines()[0]
    )
    watch.accept_restart()
    assert watch.lines() == []


@pytest.mark.parametrize("before", [80_000, 10**9, 2**32 - 10**6])
@pytest.mark.parametrize("on_again_s", [0.1, 5.0, 50.0])
def test_a_count_that_began_anew_in_a_pause_is_a_restart_however_high_it_is_by_now(
    before, on_again_s
):
    earlier = counted(before)
    watch = watched([*earlier, round(8000 * on_again_s)], pause_s=60.0, pause_at=len(earlier))
    assert watch.has_restarted


@pytest.mark.parametrize("pause_s", [1.0, 60.0, 24 * 3600.0])
@pytest.mark.parametrize("before", [0, 2**31, 2**32 - 10**4])
def test_a_pause_in_which_the_count_went_on_is_no_restart(pause_s, before):
    earlier = counted(before)
    assert not watched(
        [*earlier, earlier[-1] + round(8000 * pause_s)], pause_s, len(earlier)
    ).has_restarted


def test_records_that_were_held_up_or_overtaken_are_no_restart():
    earlier = counted(8000)
    assert not watched([*earlier, earlier[-1] + 8], 0.8, len(earlier)).has_restarted
    assert not watched([*earlier, earlier[-5], earlier[-1] + 8]).has_restarted


def test_the_rate_of_the_count_is_measured_and_so_it_is_over_days():
    assert watched(counted(0)).ft_rate_hz == pytest.approx(8000)
    assert watched([]).ft_rate_hz == 0.0
    day = 24 * 3600.0
    watch = StreamWatch(1000.0)
    for day_number in range(20):
        watch.take(
            RdtRecord(0, round(8000 * day * day_number) % 2**32, 0, (day_number,) * 6),
            day * day_number,
        )
    assert watch.ft_rate_hz == pytest.approx(8000)
