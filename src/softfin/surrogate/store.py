"""Saves and loads surrogates: a folder with ``surrogate.json`` (networks, scaling, scores,
provenance) and ``weights.safetensors``."""

from collections.abc import Callable
from pathlib import Path

from softfin.core.errors import ArtifactError, ConfigurationError, one_line
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ, Limits
from softfin.storage import artifact as artifacts
from softfin.storage.registry import check_precision
from softfin.surrogate.protocol import SurrogatePlant
from softfin.surrogate.registry import PAPER, find_architecture

SURROGATE_KIND = "surrogate"


def save_surrogate(
    path: Path,
    surrogate: SurrogatePlant,
    scores: JsonObject | None,
    provenance: JsonObject,
    extra_files: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    **metadata: object,
) -> None:
    """Write a surrogate folder, completely or not at all.

    Args:
        path: The folder.
        surrogate: The surrogate.
        scores: Scores on test logs, if any.
        provenance: Data, seed and software versions used for the fit.
        extra_files: Function that writes additional files into the folder.
        overwrite: Replace an existing folder.
        metadata: Additional entries of ``surrogate.json``.
    """
    entries, weights = surrogate.to_files()
    description = {
        "model": surrogate.model,
        "rate_hz": RATE_HZ,
        "limits": surrogate.limits.to_dict(),
        **entries,
        "scores": scores,
        **metadata,
        "provenance": provenance,
    }
    artifacts.save(path, SURROGATE_KIND, description, weights, extra_files, overwrite)


def load_surrogate(path: str | Path) -> SurrogatePlant:
    """Load a surrogate. If its model is ``package.module:ARCHITECTURE``, the module is imported
    from the current folder or an installed package.

    Args:
        path: Folder of the surrogate.

    Returns:
        The surrogate, which is a plant.

    Raises:
        ArtifactError: If the folder is damaged, or its rate, model or channels are not supported.

    Example:
        >>> surrogate = softfin.load_surrogate("surrogate")
    """
    check_precision()
    path = Path(path)
    description, weights = artifacts.load(path, SURROGATE_KIND)
    source = str(path / f"{SURROGATE_KIND}.json")
    if description.get("rate_hz") != RATE_HZ:
        raise ArtifactError(
            f"{source}: the surrogate runs at {description.get('rate_hz')} Hz; softfin requires "
            f"{RATE_HZ} Hz"
        )
    try:
        architecture = find_architecture(str(description.get("model", PAPER)))
    except ConfigurationError as error:
        raise ArtifactError(
            f"{source}: {error}; run softfin in the folder of this module, or update softfin"
        ) from error
    try:
        surrogate = architecture.load(description, weights, source)
        # Validate the limits, because the limits of the paper's networks come unchecked from the
        # scaling.
        Limits.of(surrogate.limits.to_dict())
        return surrogate
    except ConfigurationError as error:
        raise ArtifactError(
            f"{error}; this version of softfin does not support these networks; fit the surrogate "
            "again"
        ) from None
    except (KeyError, TypeError, ValueError) as error:
        reason = one_line(error)
        raise ArtifactError(
            f"{source}: invalid description of a surrogate ({reason}); fit the surrogate again"
        ) from None
