import pytest
from benchmarks.compilation import HIT, LOWER, TRACE, XLA, Compilation


@pytest.fixture
def compilation(monkeypatch: pytest.MonkeyPatch) -> Compilation:
    for name in ("register_event_duration_secs_listener", "register_event_listener"):
        monkeypatch.setattr(f"jax.monitoring.{name}", lambda listener: None)
    return Compilation()


def test_what_is_compiled_while_another_program_is_traced_is_not_counted_twice(
    compilation: Compilation, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Two small programs, one after the other, within the tracing of a large one.
    for event, start, end, name in (
        (TRACE, 11, 12, "small"),
        (XLA, 12, 14, "jit(small)"),
        (XLA, 15, 16, "jit(small)"),
        (TRACE, 10, 20, "large"),
        (LOWER, 20, 23, "jit(large)"),
        ("/jax/other", 0, 100, "large"),
        (XLA, 23, 30, "jit(large)"),
    ):
        monkeypatch.setattr("time.perf_counter", lambda end=end: float(end))
        compilation._note_span(event, end - start, fun_name=name)
    compilation._note_event(HIT)
    compilation._note_event("/jax/other")
    assert [compilation.seconds(event) for event in (TRACE, LOWER, XLA)] == [1 + 6, 3, 3 + 7]
    assert compilation.seconds() == 20
    assert compilation.seconds_of[TRACE, "large elsewhere"] == 6
    assert (
        compilation.programs,
        compilation.programs_of["small elsewhere"],
        compilation.cache_hits,
    ) == (3, 2, 1)
