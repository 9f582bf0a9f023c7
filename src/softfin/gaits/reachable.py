"""The mean forces that a fin can make: a region of the force plane, star-shaped about a force well inside it.

Its edge is kept as a radius in equally spaced directions, so whether a force is inside is one division, and any force
is brought inside by going towards the centre or to the nearest point of the edge.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from softfin.core.quantities import AnyArray


class Reachable(NamedTuple):
    """A star-shaped polygon."""

    centre: Float[AnyArray, "2"]
    """(x, y) [N]."""
    radius: Float[AnyArray, "directions"]
    """From the centre to the corners [N]; corner k lies in the direction of 2 pi k / directions, counted from +x."""

    @classmethod
    def of(cls, description: dict[str, Any]) -> "Reachable":
        """From what `described` gave; raises KeyError, TypeError, ValueError for anything else."""
        centre, radius = (np.asarray(description[name], np.float32) for name in ("centre_n", "radius_n"))
        if centre.shape != (2,) or radius.ndim != 1 or len(radius) < 3:
            raise ValueError(f"reachable: centre {centre.shape} and radius {radius.shape} describe no region")
        if not np.isfinite(centre).all() or not (np.isfinite(radius) & (radius >= 0)).all():
            raise ValueError("reachable: centre and radius must be finite, and no radius under 0")
        return cls(centre, radius)

    def described(self) -> dict[str, Any]:
        """For JSON: the centre [N] and the distance of each corner from it [N]."""
        return {
            "centre_n": [round(float(x), 5) for x in self.centre],
            "radius_n": [round(float(x), 5) for x in self.radius],
        }

    def corners(self) -> Float[np.ndarray, "directions 2"]:
        """Of the polygon [N], anticlockwise."""
        corners: Float[np.ndarray, "directions 2"]
        corners = np.asarray(self.centre) + np.asarray(self.radius)[:, None] * directions(len(self.radius))
        return corners

    def pulled(self, force: Float[AnyArray, "2"]) -> Float[Array, "2"]:
        """The force, or where the line from it to the centre meets the edge; traceable."""
        return jnp.asarray(_pulled(*(jnp.asarray(each) for each in (self.centre, self.radius, force))))

    def distances(self, centre: Float[np.ndarray, "2"]) -> Float[np.ndarray, "directions"]:
        """From a force inside to where lines in the directions of the corners first leave the region [N]."""
        if np.array_equal(centre, self.centre):
            return np.asarray(self.radius)
        start = self.corners().astype(float) - centre
        side = np.roll(start, -1, axis=0) - start
        way = directions(len(start)).astype(float)[:, None]

        def cross(a: Float[np.ndarray, "*#n 2"], b: Float[np.ndarray, "*#n 2"]) -> Float[np.ndarray, "*n"]:
            return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])

        # The line way * reach meets the side start + side * along.
        across = cross(way, side)
        across = np.where(np.abs(across) < 1e-12, np.inf, across)
        reach, along = cross(start, side) / across, cross(start, way) / across
        meets = np.isfinite(across) & (reach >= 0) & (along >= -1e-9) & (along <= 1 + 1e-9)
        least = np.where(meets, reach, np.inf).min(axis=1)
        return np.asarray(np.where(np.isfinite(least), least, 0), np.float32)

    def contains(self, force: tuple[float | int, float | int], tolerance_n: float = 1e-3) -> bool:
        """Whether the force is inside or within the tolerance of the edge."""
        return float(np.hypot(*np.subtract(force, self.nearest(force)))) <= tolerance_n

    def nearest(self, force: tuple[float | int, float | int]) -> tuple[float, float]:
        """The force where it is inside, else the nearest point of the edge [N]."""
        at = np.asarray(force, float)
        if np.allclose(np.asarray(self.pulled(at.astype(np.float32))), at, atol=1e-5):
            return float(at[0]), float(at[1])
        a = self.corners().astype(float)
        side = np.roll(a, -1, axis=0) - a
        along = np.clip(((at - a) * side).sum(1) / np.maximum((side**2).sum(1), 1e-12), 0, 1)
        points = a + along[:, None] * side
        x, y = points[np.argmin(((points - at) ** 2).sum(1))]
        return float(x), float(y)

    def area(self) -> float:
        """Of the polygon [N^2]."""
        turn = 2 * np.pi / len(self.radius)
        radius = np.asarray(self.radius, float)
        return float(np.sin(turn) / 2 * (radius * np.roll(radius, -1)).sum())

    def box(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Least and greatest (x, y) [N]."""
        corners = self.corners()
        (x0, y0), (x1, y1) = corners.min(0).tolist(), corners.max(0).tolist()
        return (x0, y0), (x1, y1)


def directions(count: int) -> Float[np.ndarray, "directions 2"]:
    """Equally spaced unit vectors, anticlockwise from +x."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.cos(angle), np.sin(angle)], axis=1).astype(np.float32)


@jax.jit
def _pulled(
    centre: Float[Array, "2"], radius: Float[Array, "directions"], force: Float[Array, "2"]
) -> Float[Array, "2"]:
    offset = force - centre
    count = len(radius)
    turn = jnp.arctan2(offset[1], offset[0]) / (2 * jnp.pi) % 1 * count
    index = jnp.minimum(turn.astype(jnp.int32), count - 1)
    corners = radius[:, None] * directions(count)
    a, b = corners[index], corners[(index + 1) % count]
    # The ray offset * s meets the side a + (b - a) t where offset x (a - b) s = a x (a - b).
    side = a - b
    across = offset[0] * side[1] - offset[1] * side[0]
    reach = (a[0] * side[1] - a[1] * side[0]) / jnp.where(jnp.abs(across) < 1e-9, jnp.inf, across)
    inside = (reach >= 1) | (jnp.abs(offset).max() < 1e-6)
    return jnp.where(inside, force, centre + offset * reach)
