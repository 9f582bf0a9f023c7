"""Finds surrogate architectures by name: softfin's own, or ``package.module:ARCHITECTURE``.

An architecture is imported on first use, so the names are available without JAX.
"""

from typing import TYPE_CHECKING

from softfin.core.errors import ConfigurationError, one_line
from softfin.storage.registry import import_object

if TYPE_CHECKING:
    from softfin.surrogate.protocol import Architecture

DEFAULT = "streaming"
"""Architecture that is fitted by default."""

PAPER = "paper"
"""The paper's networks."""

ARCHITECTURES = {
    DEFAULT: "softfin.surrogate.streaming.architecture:STREAMING_ARCHITECTURE",
    PAPER: "softfin.surrogate.paper.architecture:PAPER_ARCHITECTURE",
}
"""softfin's own architectures."""

ARCHITECTURE_NAMES = f"{', '.join(ARCHITECTURES)}, or package.module:ARCHITECTURE (your own)"
"""Names that `find_architecture` accepts, for error messages."""


def find_architecture(name: str) -> "Architecture":
    """Import an architecture: one of `ARCHITECTURES`, or ``package.module:ARCHITECTURE`` in the
    current folder or an installed package.

    Raises:
        ConfigurationError: If there is no such architecture, or its module cannot be imported.
    """
    place = ARCHITECTURES.get(name, name)
    if ":" not in place:
        raise ConfigurationError(
            f"surrogate architecture {name}: unknown; use {ARCHITECTURE_NAMES}"
        )
    from softfin.surrogate.protocol import Architecture

    try:
        architecture = import_object(place)
    except Exception as error:
        # The user's code may raise any error.
        raise ConfigurationError(
            f"surrogate architecture {name}: {type(error).__name__}: {one_line(error)}; use "
            f"{ARCHITECTURE_NAMES}"
        ) from error
    if not isinstance(architecture, Architecture):
        raise ConfigurationError(
            f"surrogate architecture {name}: a {type(architecture).__name__} is not a "
            f"softfin.surrogate.Architecture; use {ARCHITECTURE_NAMES}"
        )
    return architecture
