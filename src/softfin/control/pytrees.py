"""Controllers as JAX pytrees, for compiled programs that take a controller as an argument."""

import dataclasses
from functools import cache

import jax

from softfin.control.controller import LoadedController
from softfin.control.feedback import Feedback
from softfin.control.gait import GaitStep
from softfin.control.grid import GridStep
from softfin.control.single import SingleStep


@cache
def register_controllers() -> None:
    """Register the classes of controllers as pytrees; fields are leaves unless they are `STATIC` or
    `DROPPED`.

    The classes cannot register themselves, because a robot runs them without JAX.
    """
    for each in (LoadedController, Feedback, SingleStep, GridStep, GaitStep):
        names: dict[str, list[str]] = {"leaf": [], "static": [], "dropped": []}
        for field in dataclasses.fields(each):
            role = next(iter(field.metadata), "leaf")
            names[role].append(field.name)
        jax.tree_util.register_dataclass(each, *names.values())
