"""Checks the arguments of public functions when they are called from Python."""

import functools
import inspect
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from softfin.core.errors import ConfigurationError


def check_arguments(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function so that it raises ConfigurationError for an argument that it does not
    have, or for something else instead of a path."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: object, **options: object) -> Any:
        where = f"softfin.{function.__name__}"
        try:
            bound = signature.bind(*args, **options)
        except TypeError as error:
            names = ", ".join(signature.parameters)
            raise ConfigurationError(f"{where}: {error}; its parameters are {names}") from None
        for name, value in bound.arguments.items():
            hint = signature.parameters[name].annotation
            kinds = get_args(getattr(hint, "__origin__", hint))
            allowed = [os.PathLike, *(kind for kind in kinds if isinstance(kind, type))]
            paths = value if isinstance(value, tuple) else [value]
            for path in paths if Path in kinds else []:
                if not isinstance(path, tuple(allowed)):
                    raise ConfigurationError(
                        f"{where}: {name}: is of type {type(path).__name__}; use the path of a "
                        "file or folder"
                    )
        return function(*args, **options)

    return checked
