"""The family of a fin: the ways in which the fin may change, described by a few coefficients.

A soft fin changes with temperature, age and damage, and differs from one piece to the next. The
same is true of its servo and its sensor. A few coefficients describe the effects of all these
changes on the mean force at every reference, and on all measurements while the controller runs.
`softfin.evaluation.find_family` finds the family by simulation; this module stores and interpolates
it. No JAX.

The family consists of tables over lattices of references. At each node, the tables contain the
values for the nominal fin and their derivatives with respect to each coefficient.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.control.controller import LoadedController
from softfin.control.gait import GaitStep
from softfin.core.errors import ArtifactError
from softfin.core.operations import Array, Operations
from softfin.core.quantities import AnyArray
from softfin.storage import artifact as artifacts

FAMILY_KIND = "family"
"""Kind of the folder, and its name within the folder of the controller."""

MIN_FINS = 20
"""Minimum number of fins in a family."""

FEATURES = (
    "force_x",
    "force_y",
    "angle",
    "torque",
    "power",
    "motor_torque",
    "motor_power",
)
"""Measurements of one action: mean force (x, y) [N], shaft angle at the end of the action [rad],
and mean torque [N m] and power [W], first on the fin, then of the motor."""

FORCE_FEATURES = slice(0, 2)
"""Features that require a force sensor."""
LOAD_FEATURES = slice(3, 7)
"""Features that require a measured torque or current."""
MOTOR_FEATURES = slice(5, 7)
"""Features that depend on friction and on the torque constant."""


class Family(NamedTuple):
    """Tables of a family over lattices of references with the same corners, and the errors that
    remain when the coefficients describe the fins."""

    low: Float[AnyArray, "2"]
    """Lower corner (x, y) of the lattices [N]."""
    high: Float[AnyArray, "2"]
    """Upper corner (x, y) of the lattices [N]."""
    nominal: Float[AnyArray, "x y actions features"]
    """`FEATURES` of each action of a window for the nominal fin. This lattice is finer than that of
    the changes, because the gaits of neighbouring references can differ greatly."""
    nominal_noise: Float[AnyArray, "x y features"]
    """Standard deviation of the interpolation error between the nodes of `nominal`."""
    friction: Float[AnyArray, "x y actions 2"]
    """Change in `MOTOR_FEATURES` per 1 N m of friction: mean sign [-] and mean magnitude [rad/s] of
    the shaft velocity during each action of the nominal fin."""
    force: Float[AnyArray, "x y coefficients 2"]
    """Change in the true mean force (x, y) per unit of each coefficient [N]."""
    features: Float[AnyArray, "x y actions coefficients features"]
    """Change in the features per unit of each coefficient."""
    force_noise: Float[AnyArray, "2"]
    """Standard deviation of the part of the mean force (x, y) that is not explained [N]."""
    feature_noise: Float[AnyArray, "features"]
    """Standard deviation of the part of each feature that is not explained."""
    feature_spread: Float[AnyArray, "features"]
    """Standard deviation of each feature of the nominal fin over the references."""

    @property
    def coefficients(self) -> int:
        """Number of coefficients."""
        return int(self.force.shape[2])

    def interpolate(
        self, ops: Operations, references: Array, *tables: Array, own: tuple[Array, ...] = ()
    ) -> list[Array]:
        """Interpolate tables of the same lattice at ``(references, 2)``, linearly in x and y. `own`
        contains indices for the axes after x and y, with one entry per reference."""
        xp = ops.xp
        last = np.array(tables[0].shape[:2]) - 1
        low = ops.constant(self.low)
        at = (references - low) / (ops.constant(self.high) - low) * last
        at = xp.clip(at, 0.0, last - 1e-5)
        corner = at.astype(np.int32)
        within = at - corner
        x = corner[:, 0]
        y = corner[:, 1]
        blended = []
        for table in tables:
            values = ops.constant(table)
            along_x = within[:, 0].reshape(-1, *[1] * (values.ndim - 2 - len(own)))
            along_y = within[:, 1].reshape(-1, *[1] * (values.ndim - 2 - len(own)))
            lower = (1 - along_y) * values[x, y, *own] + along_y * values[x, y + 1, *own]
            upper = (1 - along_y) * values[x + 1, y, *own] + along_y * values[x + 1, y + 1, *own]
            blended.append((1 - along_x) * lower + along_x * upper)
        return blended


def save_family(
    path: Path, controller: LoadedController, family: Family, keys: Mapping[str, object]
) -> None:
    """Write a family into the folder of its controller, replacing an existing family."""
    description = {"controller_sha256": controller.artifact.weights_sha256, **keys}
    # The rounding error of half precision is about 1% of the noise of the features.
    arrays = {name: np.asarray(part, np.float16) for name, part in family._asdict().items()}
    artifacts.save(path / FAMILY_KIND, FAMILY_KIND, description, arrays, overwrite=True)


def load_family(path: Path, controller: LoadedController) -> Family | None:
    """Read the family from the folder of a controller; return None if there is none, or if the
    controller is a policy, whose motion does not repeat.

    Raises ArtifactError if the family is damaged or belongs to a different controller.
    """
    folder = path / FAMILY_KIND
    if not folder.exists() or controller.kind != GaitStep.kind:
        return None
    again = f"run softfin family {path}"
    description, arrays = artifacts.load(folder, FAMILY_KIND)
    if description.get("controller_sha256") != controller.artifact.weights_sha256:
        raise ArtifactError(f"{folder}: made for a controller with different weights; {again}")
    fins = description.get("configuration", {}).get("fins", 0)
    if fins < MIN_FINS:
        raise ArtifactError(
            f"{folder}: made from {fins} fins, expected at least {MIN_FINS}; {again}"
        )
    try:
        family = Family(**{name: np.asarray(part, np.float32) for name, part in arrays.items()})
        actions = controller.clock.window_actions
        grid = family.nominal.shape[:2]
        motor = MOTOR_FEATURES.stop - MOTOR_FEATURES.start
        expected = (grid, actions, len(FEATURES), (*grid, actions, motor))
        found = (
            family.nominal_noise.shape[:2],
            *family.nominal.shape[2:],
            family.friction.shape,
        )
        coefficients = family.features.shape[3]
        if expected != found or coefficients != family.coefficients:
            raise ValueError(f"arrays of shape {found}, must be {expected}")
        if not all(np.isfinite(part).all() for part in family):
            raise ValueError("contains numbers that are not finite")
    except (TypeError, ValueError, IndexError) as error:
        raise ArtifactError(f"{folder}: damaged ({error}); {again}") from None
    return family
