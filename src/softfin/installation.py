"""How softfin was installed, the extras that are there, and the command that adds one; the standard library alone."""

import importlib.metadata
import json
import re
from typing import Any
from urllib.parse import unquote, urlparse

EXTRAS = ("learn", "onnx", "ros2", "ray", "sb3")
"""Parts of softfin beside the robot's, as pyproject.toml has them; `learn` records in simulation, learns and draws."""

DISTRIBUTIONS = {"PIL": "pillow", "jaxlib": "jax", "stable_baselines3": "sb3-contrib"}
"""Distributions of modules that have another name."""


def version_of(distribution: str) -> str | None:
    """Version of an installed distribution; None where it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None


def requirements_of(extra: str | None) -> list[str]:
    """Distributions that softfin itself needs, or that an extra of it adds."""
    names = []
    for line in importlib.metadata.requires("softfin") or ():
        requirement, _, marker = line.partition(";")
        of = re.search(r"extra == ['\"]([\w-]+)['\"]", marker)
        name = re.split(r"[\s<>=!~\[(]", requirement.strip())[0].lower().replace("_", "-")
        if (of and of[1]) == extra and name != "softfin":
            names.append(name)
    return names


def missing_from(extra: str | None) -> list[str]:
    """Distributions of an extra, or of softfin itself, that are not installed."""
    return [name for name in requirements_of(extra) if version_of(name) is None]


def extra_of(error: ModuleNotFoundError) -> str | None:
    """The extra that brings the module that was not there; None where none does."""
    module = (error.name or "").partition(".")[0]
    distribution = DISTRIBUTIONS.get(module, module).lower().replace("_", "-")
    return next((extra for extra in EXTRAS if distribution in requirements_of(extra)), None)


def how_to_add(extra: str) -> str:
    """The command that adds an extra to this installation, from the wheel or folder that it was installed from."""
    source = origin()
    if source is None:
        # Nothing is published: by its name alone pip would find nothing, or somebody else's package.
        wheel = f"dist/softfin-{version_of('softfin')}-py3-none-any.whl"
        return f'make wheel, in a checkout of softfin, then pip install "{wheel}[{extra}]"'
    url = source["url"]
    if source.get("dir_info", {}).get("editable"):
        return f'pip install -e "{unquote(urlparse(url).path)}[{extra}]"'
    vcs = source.get("vcs_info", {}).get("vcs")
    return f'pip install "softfin[{extra}] @ {f"{vcs}+" if vcs else ""}{url}"'


def origin() -> dict[str, Any] | None:
    """The wheel, folder or repository that softfin was installed from (PEP 610); None where nobody knows."""
    text = importlib.metadata.distribution("softfin").read_text("direct_url.json")
    return json.loads(text) if text else None
