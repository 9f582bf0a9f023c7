"""Checks the arguments of public functions when they are called from Python."""

import functools
import inspect
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from softfin.core.errors import ConfigurationError, SoftfinError


def check_arguments(function: Callable[..., Any]) -> Callable[..., Any]:
    """Decorate a function so that it raises ConfigurationError if it has no such argument, or if a
    path is expected and the value is not one. Its other error messages contain parameters, not
    options."""
    signature = inspect.signature(function)

    def parameter(option: re.Match[str]) -> str:
        name = option[1].replace("-", "_")
        if name not in signature.parameters:
            return option[0]
        is_flag = isinstance(signature.parameters[name].default, bool)
        return f"{name}=True" if is_flag else name

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
        try:
            return function(*args, **options)
        except SoftfinError as error:
            text = str(error)
            # Suggested commands keep their options.
            if "softfin " not in text:
                error.args = (re.sub("--([a-z][a-z-]*)", parameter, text),)
            raise

    return checked
