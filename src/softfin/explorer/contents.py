"""Plants and controllers as plain data for the page: weights in base64, configurations as JSON.

From these data, the page scripts repeat the computations of `softfin.tank`,
`softfin.surrogate.streaming` and `softfin.control`.
"""

import base64
from collections.abc import Sequence

import equinox as eqx
import numpy as np

from softfin.control.controller import LoadedController
from softfin.control.family import Family
from softfin.control.feedback import Feedback
from softfin.control.gait import GaitStep
from softfin.control.grid import GridStep
from softfin.control.single import SingleStep
from softfin.core.action_clock import ActionClock
from softfin.core.errors import PlantError
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant
from softfin.core.power import EC_MAX_30
from softfin.core.quantities import AnyArray, Limits
from softfin.gaits.gait import GaitTable
from softfin.surrogate.protocol import ExplorableSurrogate
from softfin.surrogate.training import name_net_arrays
from softfin.tank import Tank
from softfin.tank.drive import DEAD_TICKS

HAND_STROKE_RAD = 0.5
"""Initial amplitude of a stroke by the user's hand [rad]; the stroke produces forward thrust."""


SINGLE_PRECISION = "<f4"
"""Little-endian on every machine, as expected by the page script."""
HALF_PRECISION = "<f2"


def encode_arrays(array: AnyArray, precision: str = SINGLE_PRECISION) -> JsonObject:
    """Return the shape of an array, and its values in single or half precision as base64."""
    values = np.asarray(array, precision)
    return {"shape": list(values.shape), "data": base64.b64encode(values.tobytes()).decode()}


def is_shown(plant: Plant) -> bool:
    """Whether the page can simulate this plant."""
    return isinstance(plant, Tank | ExplorableSurrogate)


def plant_data(name: str, plant: Plant) -> JsonObject:
    """Return the data of a virtual tank or a streaming surrogate; raises PlantError for any other
    plant."""
    if isinstance(plant, Tank):
        return tank_data(plant)
    if isinstance(plant, ExplorableSurrogate):
        return surrogate_data(plant)
    kind = (
        f"a surrogate of kind {plant.model!r}"
        if hasattr(plant, "model")
        else f"a {type(plant).__name__}"
    )
    raise PlantError(
        f"plant {name}: {kind} cannot run on the page, which supports virtual tanks and streaming "
        "surrogates; use --plant tank, or a surrogate from softfin fit --model streaming"
    )


def tank_data(tank: Tank) -> JsonObject:
    """Return the data of a virtual tank, without the sensor noise, drift and resolution."""
    return {
        "kind": "tank",
        "steps_per_tick": tank.steps_per_tick,
        "drive": {**_numbers(tank.drive), "dead_ticks": DEAD_TICKS},
        "fin": _numbers(tank.fin),
        "water": _numbers(tank.water),
        "sensor": _numbers(tank.sensor),
        "motor": EC_MAX_30._asdict(),
        "rest_rad": tank.limits.rest_angle,
    }


def outline(tank: Tank) -> JsonObject:
    """Return the shape of the fin in a tank: the length [m], and the thickness of the plates [m],
    mount first."""
    return {
        "length_m": float(tank.fin.plate_length) * len(tank.fin.stiffness),
        "thickness_m": np.asarray(tank.fin.thickness, float).tolist(),
    }


def surrogate_data(surrogate: ExplorableSurrogate) -> JsonObject:
    """Return the data of a surrogate, with its state after a long rest."""
    entries, arrays = surrogate.explorer_data()
    encoded = {name: encode_arrays(array) for name, array in arrays.items()}
    return {"kind": "surrogate", **entries, "arrays": encoded}


def controller_data(controller: LoadedController, family: Family | None = None) -> JsonObject:
    """Return the data of a controller of any kind, and the configuration of its optional
    feedback."""
    step = controller.step
    reachable = controller.reachable
    feedback = Feedback(controller, family=family)
    assert feedback.newtons is not None
    data: JsonObject = {
        "kind": controller.kind,
        "limits": controller.limits.to_dict(),
        "rest_rad": controller.limits.rest_angle,
        "cells": [cell.model_dump(mode="json") for cell in controller.cells],
        "reachable": None if reachable is None else reachable.to_dict(),
        "clock": controller.clock.model_dump(mode="json"),
        "size": 1.0 if reachable is None else reachable.size,
        "feedback": {
            "config": {
                **feedback.config.model_dump(mode="json"),
                **feedback.newtons._asdict(),
                "reach_n": feedback.reach_n,
            },
            "family": None if family is None else _family(family),
        },
    }
    if isinstance(step, GaitStep):
        return data | {"table": _table(step.table)}
    assert isinstance(step, SingleStep | GridStep)
    network = step.networks if isinstance(step, GridStep) else step.network
    return data | {
        "network": {name: encode_arrays(array) for name, array in network._asdict().items()},
        "task": {"past_actions": step.observation.past_actions},
        "rest": list(step.rest),
    }


def hand_data(limits: Sequence[Limits], clock: ActionClock, size: float | None) -> JsonObject:
    """Return the data of the user's hand, which moves fins within all these limits in place of a
    controller.

    `size` is the fin size of the controllers on the page; without one, the page finds it from the
    forces of the fin.
    """
    highest = np.max(limits, axis=0)
    lowest = np.min(limits, axis=0)
    common = Limits(highest[0], lowest[1], highest[2], lowest[3])
    # A stroke to the other side takes two thirds of an action.
    velocity = 2 * HAND_STROKE_RAD * clock.rate_hz * 1.5
    first = {
        "angle": common.rest_angle,
        "stroke": min(HAND_STROKE_RAD, (common.angle_max - common.angle_min) / 2),
        "velocity": min(max(velocity, common.velocity_min), common.velocity_max),
    }
    return {
        "name": "by hand",
        "kind": "hand",
        "limits": common.to_dict(),
        "rest_rad": common.rest_angle,
        "cells": [],
        "reachable": None,
        "clock": clock.model_dump(mode="json"),
        "size": size,
        "first": first,
    }


def _table(table: GaitTable) -> JsonObject:
    low = np.asarray(table.low, float)
    high = np.asarray(table.high, float)
    return {"low": low.tolist(), "high": high.tolist(), "actions": encode_arrays(table.actions)}


def _family(family: Family) -> JsonObject:
    # Families are stored in half precision.
    return {name: encode_arrays(table, HALF_PRECISION) for name, table in family._asdict().items()}


def _numbers(module: eqx.Module) -> JsonObject:
    """Return the arrays of a module as nested numbers, under the names of its fields."""
    numbers: JsonObject = {}
    for place, array in name_net_arrays(module).items():
        *outer, last = place.split(".")
        inside = numbers
        for name in outer:
            inside = inside.setdefault(name, {})
        inside[last] = np.asarray(array, float).tolist()
    return numbers
