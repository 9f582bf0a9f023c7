"""Configuration of a robot's body: inertia, added mass, weight and buoyancy."""

import numpy as np
from pydantic import NonNegativeFloat, PositiveFloat, model_validator

from softfin.core.configuration import Configuration

GRAVITY_M_S2 = 9.81

Three = tuple[float, float, float]
SixNotNegative = tuple[
    NonNegativeFloat,
    NonNegativeFloat,
    NonNegativeFloat,
    NonNegativeFloat,
    NonNegativeFloat,
    NonNegativeFloat,
]


class BodyConfig(Configuration):
    """A rigid body in water, in body axes about the origin: x forward, y left, z up (REP 103)."""

    mass_kg: PositiveFloat
    """Mass [kg]."""
    inertia_kg_m2: Three | tuple[Three, Three, Three]
    """Inertia about the centre of gravity, as three moments or as a matrix [kg m2]."""
    added_mass: SixNotNegative = (0, 0, 0, 0, 0, 0)
    """Added mass along x, y and z [kg], and added inertia about them [kg m2]."""
    centre_of_gravity_m: Three = (0, 0, 0)
    """Centre of gravity [m]."""
    centre_of_buoyancy_m: Three = (0, 0, 0)
    """Centre of buoyancy [m]."""
    buoyancy_n: NonNegativeFloat | None = None
    """Buoyancy [N]; None means neutral buoyancy."""

    @property
    def upward_n(self) -> float:
        """Buoyancy [N]."""
        return self.mass_kg * GRAVITY_M_S2 if self.buoyancy_n is None else self.buoyancy_n

    def moments(self) -> np.ndarray:
        """Return the inertia about the centre of gravity as a matrix ``(3, 3)`` [kg m2]."""
        given = np.asarray(self.inertia_kg_m2, float)
        return np.diag(given) if given.ndim == 1 else given

    @property
    def righting_nm_rad(self) -> float:
        """Righting stiffness due to weight and buoyancy in roll and pitch [N m/rad]; if negative,
        the body tips over."""
        weight = self.mass_kg * GRAVITY_M_S2
        return self.upward_n * self.centre_of_buoyancy_m[2] - weight * self.centre_of_gravity_m[2]

    def inertia(self) -> np.ndarray:
        """Return the inertia about the origin as a matrix ``(6, 6)``, including the added mass
        (Fossen 2021, 3.3)."""
        x, y, z = self.centre_of_gravity_m
        # M = [[m I, -m S], [m S, I_g - m S S]], with S v = r_g x v.
        lever = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        mass = self.mass_kg
        own = np.block(
            [
                [mass * np.eye(3), -mass * lever],
                [mass * lever, self.moments() - mass * lever @ lever],
            ]
        )
        return np.asarray(own + np.diag(self.added_mass))

    @model_validator(mode="after")
    def _is_a_body(self) -> "BodyConfig":
        moments = self.moments()
        if not np.allclose(moments, moments.T):
            raise ValueError(
                f"inertia_kg_m2 = {moments.tolist()} is not symmetric; use a symmetric matrix"
            )
        least, middle, most = np.linalg.eigvalsh(moments)
        if least <= 0:
            raise ValueError(
                f"inertia_kg_m2 = {np.asarray(self.inertia_kg_m2).tolist()} is singular or "
                f"negative: its smallest principal moment is {least:.4g} kg m2; all must be "
                "positive"
            )
        # Triangle inequality of the principal moments, with a tolerance for flat bodies.
        if least + middle < most * (1 - 1e-6):
            raise ValueError(
                f"inertia_kg_m2 has principal moments {least:.4g}, {middle:.4g}, {most:.4g}, but "
                "none can exceed the sum of the other two; check the values"
            )
        return self
