"""Architectures of surrogates by name: softfin's own, and those of installed packages, which add
them with the entry point group ``softfin.surrogates``.

An architecture is imported on first use, so listing the names needs no JAX.
"""

from collections.abc import Mapping
from importlib.metadata import EntryPoint
from typing import TYPE_CHECKING

from softfin.core.errors import ConfigurationError, one_line
from softfin.storage.plugins import list_plugins

if TYPE_CHECKING:
    from softfin.core.configuration import Configuration
    from softfin.surrogate.protocol import Architecture, TableOneRow

ENTRY_POINT_GROUP = "softfin.surrogates"
"""Group of the entry points ``NAME = "package.module:ARCHITECTURE"`` of other packages."""

DEFAULT = "streaming"
"""Architecture that is fitted by default."""

PAPER = "paper"
"""The paper's networks, with whose cost others are compared. Folders of the first versions of
softfin name no architecture and contain these."""

ARCHITECTURES = {
    DEFAULT: "softfin.surrogate.streaming.architecture:STREAMING_ARCHITECTURE",
    PAPER: "softfin.surrogate.paper.architecture:PAPER_ARCHITECTURE",
}
"""softfin's own architectures. An entry point of the same name is ignored."""


def list_architectures() -> dict[str, EntryPoint]:
    """Return all architectures by name, softfin's own first."""
    return list_plugins(ENTRY_POINT_GROUP, ARCHITECTURES)


def find_architecture(name: str) -> "Architecture":
    """Import the architecture `name`, which must be one of `list_architectures`.

    Raises:
        ConfigurationError: its package cannot be imported.
    """
    entry_point = list_architectures()[name]
    try:
        architecture: Architecture = entry_point.load()
    except Exception as error:
        # The code of another package may raise any error.
        raise ConfigurationError(
            f"surrogate architecture {name}: {entry_point.value} cannot be imported "
            f"({type(error).__name__}: {one_line(error)}); repair or uninstall its package"
        ) from error
    return architecture


def find_fitted_architecture(config: "Configuration") -> "Architecture":
    """Return the architecture that a fit with this configuration produces.

    Raises:
        ConfigurationError: no architecture has a configuration of this class.
    """
    config_names = []
    for name in list_architectures():
        architecture = find_architecture(name)
        if isinstance(config, architecture.config):
            return architecture
        config_names.append(architecture.config.__name__)
    raise ConfigurationError(
        f"config: {type(config).__name__} does not configure the fit of a surrogate; use "
        f"{', '.join(config_names)}"
    )


def find_table_one_rows(scores: Mapping[str, object]) -> "Mapping[str, TableOneRow]":
    """Return the rows of Table I of the architecture whose networks have these scores.

    Raises:
        ConfigurationError: no architecture has networks of these names.
    """
    for name in list_architectures():
        rows = find_architecture(name).table_one
        if scores.keys() <= rows.keys():
            return rows
    raise ConfigurationError(
        f"Table I: no surrogate architecture has the networks {', '.join(scores)}; install the "
        "package of this architecture"
    )
