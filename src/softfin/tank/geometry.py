"""Geometry and material of the soft fin, and the integrals over each plate of the chain that stands for it."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from softfin.core.configuration import Configuration
from softfin.tank.chain import PerPlate


class FinConfig(Configuration):
    """Geometry and material; thickness and span change linearly from root to tip.

    Length, bracket, modulus and damping are a calibration's against the published fin (docs/tank.md); span and
    thickness were held, as no recording tells them from modulus and drag.
    """

    plates: int = Field(8, ge=1, le=32)
    """Rigid plates in the chain [-]; the error of the force falls at least as their number squared."""
    length_m: float = Field(0.187, gt=0)
    """Length from the shaft to the tip [m]."""
    root_length_m: float = Field(0.0195, ge=0)
    """Length of the aluminium bracket that stiffens the root, from the shaft [m]."""
    span_m: float = Field(0.081, gt=0)
    """Span across the plane of beating, at the shaft [m]."""
    tip_span_ratio: float = Field(1.0, gt=0)
    """Span at the tip over that at the shaft [-]."""
    root_thickness_m: float = Field(0.019, gt=0)
    """Thickness at the shaft [m]."""
    tip_thickness_ratio: float = Field(1.0, gt=0)
    """Thickness at the tip over that at the shaft [-]."""
    youngs_modulus_pa: float = Field(2.72e6, gt=0)
    """Young's modulus in bending [Pa]; by the hardness, Shore A 22, 0.8e6 (Gent 1958), 1.1e6 in a plate."""
    density_kg_m3: float = Field(1150.0, gt=0)
    """Density of the silicone [kg/m3]; addition silicones have 1050 to 1200."""
    damping_s: float = Field(0.0273, ge=0)
    """Kelvin-Voigt time: damping over stiffness of each joint [s]; a loss factor of 0.27 at 1.6 Hz."""

    @model_validator(mode="after")
    def _within(self) -> "FinConfig":
        if self.root_length_m > self.length_m:
            raise ValueError(f"root_length_m must not be above length_m = {self.length_m:g}")
        return self

    def span(self, along: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Return the span of the fin at distances from the shaft [m]."""
        return self.span_m * (1 - (1 - self.tip_span_ratio) * along / self.length_m)

    def thickness(self, along: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
        """Return the thickness of the fin at distances from the shaft [m]."""
        return self.root_thickness_m * (1 - (1 - self.tip_thickness_ratio) * along / self.length_m)


BRACKET_BENDING_N_M = 70e9 * 0.003**3 / 12
"""Bending stiffness over span of the aluminium bracket [N m]: 70 GPa, taken to be 3 mm thick."""


def plate_moments(
    config: FinConfig, density: Callable[[NDArray[np.floating[Any]]], NDArray[np.floating[Any]]]
) -> tuple[PerPlate, PerPlate, PerPlate]:
    """Integrals of a density per length, times distance from the inner end to the power 0, 1, 2, over each plate."""
    plate = config.length_m / config.plates
    # Exact for the cubic densities of a linear taper.
    nodes, weights = np.polynomial.legendre.leggauss(4)
    inside = (nodes[:, None] + 1) / 2 * plate
    mass = weights[:, None] / 2 * plate * density(np.arange(config.plates) * plate + inside)
    zeroth, first, second = (jnp.asarray((mass * inside**order).sum(0)) for order in range(3))
    return zeroth, first, second


def compliance(config: FinConfig) -> NDArray[np.floating[Any]]:
    """Return the compliance of each joint [rad/(N m)]: the beam's, from the middle of one plate to that of the next.

    The joints bend where their plates meet, the beam all along between. So each part of beam counts by the work that a
    load on the tip does in bending it, which makes the deflection under such a load that of the beam, however few the
    plates.
    """
    plate = config.length_m / config.plates
    joints = np.arange(config.plates) * plate
    middles = joints[:-1] + plate / 2
    start, stop = np.append(0.0, middles), np.append(middles, config.length_m)

    def work(
        start: NDArray[np.floating[Any]], stop: NDArray[np.floating[Any]], bracket: float
    ) -> NDArray[np.floating[Any]]:
        nodes, weights = np.polynomial.legendre.leggauss(8)
        along = start + (nodes[:, None] + 1) / 2 * (stop - start)
        bending = config.span(along) * (config.youngs_modulus_pa * config.thickness(along) ** 3 / 12 + bracket)
        shares = weights[:, None] / 2 * (config.length_m - along) ** 2 / bending
        return np.asarray((stop - start) * shares.sum(axis=0))

    edge = np.clip(config.root_length_m, start, stop)
    whole = work(start, edge, BRACKET_BENDING_N_M) + work(edge, stop, 0.0)
    return np.asarray(whole / (config.length_m - joints) ** 2)
