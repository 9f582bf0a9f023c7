"""How far a sample lies beyond what the controller's surrogate has learnt from."""

from softfin.control.controller import TrainingRange
from softfin.rig.machine import Sample

NAMES = ("angle", "velocity", "force x", "force y")


def knows_its_range(trained: TrainingRange | None) -> bool:
    """Whether any channel can be looked at."""
    return trained is not None and any(bounds is not None for bounds in trained)


def beyond(trained: TrainingRange, sample: Sample) -> tuple[float, str]:
    """The greatest distance of any channel from its range, in widths of that range, and the channel's name."""
    values = (sample.angle, sample.velocity, sample.wrench[0], sample.wrench[1])
    worst = (0.0, NAMES[0])
    for name, value, bounds in zip(NAMES, values, trained, strict=True):
        if bounds is None:
            continue
        low, high = bounds
        distance = max(low - value, value - high, 0.0) / max(high - low, 1e-6)
        if distance > worst[0]:
            worst = (distance, name)
    return worst
