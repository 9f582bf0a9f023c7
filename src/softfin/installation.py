"""How softfin was installed, which extras are present, and the command that adds an extra. Standard
library only."""

import importlib.metadata
import json
import re
import sys
from urllib.parse import unquote, urlparse

from softfin.core.json_object import JsonObject

EXTRAS = ("learn", "onnx", "ros2", "ray", "sb3", "serial")
"""Optional parts of softfin, as in pyproject.toml; `learn` simulates, trains and draws."""

DISTRIBUTIONS = {
    "can": "python-can",
    "jaxlib": "jax",
    "serial": "pyserial",
    "stable_baselines3": "sb3-contrib",
    "yaml": "pyyaml",
}
"""Distribution names by module name, if the two differ."""


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


def missing_from(extra: str | None) -> list[str]:
    """Return the missing distributions of an extra, or of softfin itself."""
    return [name for name in extra_requirements(extra) if installed_version(name) is None]


def what_is_missing(error: ModuleNotFoundError) -> str | None:
    """Return the message for a missing module, with the fix; None if softfin does not require the
    module."""
    module = (error.name or "").partition(".")[0]
    distribution = DISTRIBUTIONS.get(module, module).lower().replace("_", "-")
    parts = [extra for extra in (None, *EXTRAS) if distribution in extra_requirements(extra)]
    if not parts:
        return None
    if (version := installed_version(distribution)) is not None:
        return (
            f"missing {error.name}, although {distribution} {version} is installed; reinstall "
            f"{distribution}"
        )
    if parts[0] is None:
        return f"missing {error.name}, which every command requires; reinstall softfin"
    return (
        f"missing {error.name} from the extra {parts[0]!r}; to install it, run "
        f"{how_to_add(parts[0])}"
    )


def how_to_add(extra: str) -> str:
    """Return the command that adds an extra to this installation, from the same wheel, folder or
    commit."""
    source = origin()
    install = "pip install"
    if installer() == "uv":
        # Environments created by uv contain no pip.
        install = f"uv pip install --python {sys.executable}"
    if source is None:
        # softfin is not published yet: by name alone, pip would find nothing, or somebody else's
        # package.
        wheel = f"dist/softfin-{installed_version('softfin')}-py3-none-any.whl"
        return f'make wheel, in a checkout of softfin, then {install} "{wheel}[{extra}]"'
    url = source["url"]
    vcs = source.get("vcs_info")
    if source.get("dir_info", {}).get("editable"):
        return f'{install} -e "{unquote(urlparse(url).path)}[{extra}]"'
    if vcs is not None:
        url = f"{vcs['vcs']}+{url}@{vcs['commit_id']}"
    return f'{install} "softfin[{extra}] @ {url}"'


def installer() -> str:
    """Return the program that installed softfin, such as pip or uv."""
    return (importlib.metadata.distribution("softfin").read_text("INSTALLER") or "pip").strip()


def origin() -> JsonObject | None:
    """Return the wheel, folder or repository from which softfin was installed (PEP 610); None if
    unknown."""
    text = importlib.metadata.distribution("softfin").read_text("direct_url.json")
    return json.loads(text) if text else None
