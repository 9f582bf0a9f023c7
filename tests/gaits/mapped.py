"""What a fin of strokes can do, found once for all tests that need it."""

from functools import cache

import equinox as eqx

from softfin.gaits import simulate
from softfin.gaits.force_map import MapConfig, find_force_map
from softfin.gaits.gait import ForceMap
from softfin.gaits.reachable import Cell
from softfin.gaits.search import GaitConfig
from softfin.gaits.simulate import Survey, SurveyConfig, survey
from tests.plants import StrokeFin

FIN = StrokeFin()
SURVEY = SurveyConfig(cycles=2, batch=256, directions=16, pushes=6)
GAITS = GaitConfig(cycles=2, steps=16, halvings=0)
WITHIN = MapConfig(
    box=Cell(low=(0.5, -0.5), high=(1.5, 0.5)), spacing_n=0.5, survey=SURVEY, gaits=GAITS
)
"""Three by three forces that the fin can make, each with ease."""

simulate_gait = eqx.filter_jit(simulate.simulate_gait)
"""Compiled once for all fins of a kind."""
steady_state_force = eqx.filter_jit(simulate.steady_state_force)


@cache
def surveyed() -> Survey:
    return survey(FIN, SURVEY)


@cache
def mapped() -> ForceMap:
    return find_force_map(FIN, WITHIN)
