"""Checks that the mean forces of a fin can be controlled: they must cover an area and exceed their
noise."""

from softfin.core.errors import PlantError
from softfin.core.plant import NoisyPlant, Plant
from softfin.gaits.reachable import Reachable

LINE_WIDTH = 0.01
"""Square root of the area of a region divided by its largest radius, below which the region is
treated as a line."""


def check_usable(plant: Plant, reachable: Reachable) -> None:
    """Raise PlantError if a fin produces no mean force, only forces on a line, or forces below the
    noise of the mean force (if the noise is known)."""
    if not reachable.radius.any():
        raise PlantError("this plant produces no mean force for any command; check its model")
    if reachable.area() < (LINE_WIDTH * reachable.radius.max()) ** 2:
        raise PlantError(
            "this plant's mean forces lie on a line, but softfin controls x and y; check its "
            "model, and check that both force axes are measured"
        )
    if not isinstance(plant, NoisyPlant):
        return
    reach_n = reachable.reach_n
    noise_n = plant.mean_force_noise_n
    if reach_n < noise_n:
        raise PlantError(
            f"this fin's reach of {reach_n:.2g} N is below the noise of its mean force, "
            f"{noise_n:.2g} N over 2 s (including drift and the fitting error); use a more "
            "sensitive force sensor or faster strokes, record more logs, or fit longer"
        )
