"""The family of a fin: how the fins that it may become differ from it, in a few coefficients.

A soft fin changes with temperature, age, damage, and from one piece to the next, and so do its
servo and its sensor. All these changes together have few dimensions: a handful of coefficients
describes what they do to the mean force, at every reference, and to everything that can be
measured while the controller runs. `softfin.evaluation.find_family` finds the family by simulation;
this module stores it and looks it up. No JAX.

Everything is tabulated over a lattice of references. At each node, a table holds the value for the
nominal fin and its derivative with respect to each coefficient.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from softfin.control.controller import LoadedController
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
"""Measurements of one action: mean force (x, y) [N], angle of the shaft at its end [rad], and mean
torque [N m] and power [W], first of the fin, then of the motor."""

FORCE_FEATURES = slice(0, 2)
"""Features that the force sensor shows."""
LOAD_FEATURES = slice(3, 7)
"""Features that the torque or the current shows."""
MOTOR_FEATURES = slice(5, 7)
"""Features that friction and the torque constant change."""


class Family(NamedTuple):
    """Tables of a family over lattices of references with the same corners, and the accuracy with
    which its coefficients describe its fins."""

    low: Float[AnyArray, "2"]
    """Lower corner (x, y) of the lattices [N]."""
    high: Float[AnyArray, "2"]
    """Upper corner (x, y) of the lattices [N]."""
    nominal: Float[AnyArray, "x y actions features"]
    """`FEATURES` of each action of a window for the nominal fin. This lattice is finer than the
    others, because gaits differ much between neighbouring references."""
    nominal_noise: Float[AnyArray, "x y features"]
    """Error of the interpolation between the nodes of `nominal`."""
    friction: Float[AnyArray, "x y actions 2"]
    """Change of `MOTOR_FEATURES` for 1 N m of friction: mean sign of the velocity of the shaft
    during each action of the nominal fin [-], and its mean magnitude [rad/s]."""
    force: Float[AnyArray, "x y coefficients 2"]
    """Change in the true mean force (x, y) for each coefficient [N]."""
    features: Float[AnyArray, "x y actions coefficients features"]
    """Change in the features for each coefficient."""
    force_noise: Float[AnyArray, "2"]
    """Standard deviation of the mean force (x, y) that the coefficients do not explain [N]."""
    feature_noise: Float[AnyArray, "features"]
    """Standard deviation of each feature that the coefficients do not explain."""
    feature_spread: Float[AnyArray, "features"]
    """Standard deviation of each feature of the nominal fin over the references."""

    @property
    def coefficients(self) -> int:
        """Number of coefficients."""
        return int(self.force.shape[2])

    def interpolate(
        self, ops: Operations, references: Array, *tables: Array, own: tuple[Array, ...] = ()
    ) -> list[Array]:
        """Interpolate tables of the same lattice at ``(references, 2)``, linearly in x and y; `own`
        are further indices, one for each reference."""
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
    """Write a family into the folder of its controller, where it replaces an older one."""
    description = {"controller_sha256": controller.artifact.weights_sha256, **keys}
    # Half precision is a hundredth of the noise of the features.
    arrays = {name: np.asarray(part, np.float16) for name, part in family._asdict().items()}
    artifacts.save(path / FAMILY_KIND, FAMILY_KIND, description, arrays, overwrite=True)


def load_family(path: Path, controller: LoadedController) -> Family | None:
    """Read the family from the folder of its controller; None if there is none.

    Raises ArtifactError if the family is damaged, or of another controller.
    """
    folder = path / FAMILY_KIND
    if not folder.exists():
        return None
    again = f"run softfin family {path}"
    description, arrays = artifacts.load(folder, FAMILY_KIND)
    if description.get("controller_sha256") != controller.artifact.weights_sha256:
        raise ArtifactError(f"{folder}: family of a controller with other weights; {again}")
    fins = description.get("configuration", {}).get("fins", 0)
    if fins < MIN_FINS:
        raise ArtifactError(
            f"{folder}: made from {fins} fins, but needs at least {MIN_FINS}; {again}"
        )
    try:
        family = Family(**{name: np.asarray(part, np.float32) for name, part in arrays.items()})
        actions = controller.clock.window_actions
        expected = (family.nominal.shape[:2], actions, len(FEATURES))
        found = (family.nominal_noise.shape[:2], *family.nominal.shape[2:])
        coefficients = family.features.shape[3]
        if expected != found or coefficients != family.coefficients:
            raise ValueError(f"arrays of shape {found}, must be {expected}")
        if not all(np.isfinite(part).all() for part in family):
            raise ValueError("contains numbers that are not finite")
    except (TypeError, ValueError, IndexError) as error:
        raise ArtifactError(f"{folder}: damaged ({error}); {again}") from None
    return family
