"""Detects the installed parts of softfin and suggests the command that adds an extra. It uses only
the standard library."""

import importlib.metadata
import re

EXTRAS = ("learn", "emulation", "onnx", "ros2", "ray", "sb3", "serial")
"""Optional parts of softfin, as in pyproject.toml; `learn` simulates, trains and draws."""

DISTRIBUTIONS = {
    "can": "python-can",
    "jaxlib": "jax",
    "serial": "pyserial",
    "stable_baselines3": "sb3-contrib",
    "yaml": "pyyaml",
}
"""Distribution names, keyed by module name, if the two differ."""


def installed_version(distribution: str) -> str | None:
    """Return the version of an installed distribution; None if it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def extra_requirements(extra: str | None) -> list[str]:
    """Return the distributions that softfin itself requires, or that one of its extras adds,
    including nested extras."""
    names: list[str] = []
    for line in importlib.metadata.requires("softfin") or ():
        requirement, _, marker = line.partition(";")
        of = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        name = re.split(r"[\s<>=!~\[(]", requirement.strip())[0].lower().replace("_", "-")
        if (of and of[1]) == extra:
            brought = re.search(r"\[([\w-]+)\]", requirement)
            names += extra_requirements(brought[1]) if name == "softfin" and brought else [name]
    return names


def what_is_missing(error: ModuleNotFoundError) -> str | None:
    """Return the message for a missing module, with the fix; None if softfin does not require the
    module."""
    module = (error.name or "").partition(".")[0]
    distribution = DISTRIBUTIONS.get(module, module).lower().replace("_", "-")
    parts = [extra for extra in (None, *EXTRAS) if distribution in extra_requirements(extra)]
    if not parts:
        return None
    if parts[0] is None or installed_version(distribution) is not None:
        return f"missing {error.name}; reinstall {distribution}"
    return (
        f"missing {error.name} from the extra {parts[0]!r}; to install it, run "
        f"{how_to_add(parts[0])}"
    )


def how_to_add(extra: str) -> str:
    """Return the command that adds an extra to this installation without changing softfin."""
    return f'pip install "softfin[{extra}]"'
