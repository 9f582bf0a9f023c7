"""What a fin of strokes can do, found once for all tests that need it."""

from functools import cache

import equinox as eqx

from softfin.gaits import simulate as beat
from softfin.gaits.force_map import ForceMap, MapConfig, map_forces
from softfin.gaits.gaits import GaitConfig
from softfin.gaits.survey import Survey, SurveyConfig, survey
from softfin.task.references import Cell
from tests.plants import StrokeFin

FIN = StrokeFin()
SURVEY = SurveyConfig(cycles=2, batch=256, directions=16, pushes=6)
GAITS = GaitConfig(cycles=2, steps=16)
WITHIN = MapConfig(box=Cell(low=(0.5, -0.5), high=(1.5, 0.5)), survey=SURVEY, gaits=GAITS)
"""Three by three forces that the fin can make, each with ease."""

made = eqx.filter_jit(beat.made)
"""Compiled once for all fins of a kind."""
steady = eqx.filter_jit(beat.steady)


@cache
def seen() -> Survey:
    return survey(FIN, SURVEY)


@cache
def known() -> ForceMap:
    return map_forces(FIN, WITHIN)
