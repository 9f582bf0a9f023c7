"""A surrogate's folder: ``surrogate.json`` (networks, scaling, scores, provenance) and
``weights.safetensors``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from softfin.core.errors import ArtifactError, ConfigurationError, one_line
from softfin.core.json_object import JsonObject
from softfin.core.quantities import RATE_HZ, Limits
from softfin.storage import artifact as artifacts
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.streaming.streaming import StreamingSurrogate

SURROGATE_KIND = "surrogate"

AnySurrogate: TypeAlias = Surrogate | StreamingSurrogate

MODELS: dict[str, type[AnySurrogate]] = {
    kind.model: kind for kind in (Surrogate, StreamingSurrogate)
}


def save_surrogate(
    path: Path,
    surrogate: AnySurrogate,
    scores: JsonObject | None,
    provenance: JsonObject,
    extra_files: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    **metadata: Any,
) -> None:
    """Write the folder, completely or not at all; `extra_files` are added to it, `metadata` to its
    JSON."""
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


def load_surrogate(path: Path) -> AnySurrogate:
    """Load the surrogate in a folder; raises ArtifactError if it is damaged or has another rate or
    other channels."""
    description, weights = artifacts.load(path, SURROGATE_KIND)
    source = str(path / f"{SURROGATE_KIND}.json")
    if description.get("rate_hz") != RATE_HZ:
        raise ArtifactError(
            f"{source}: made for {description.get('rate_hz')} Hz; softfin runs at {RATE_HZ} Hz"
        )
    model = description.get("model", "paper")
    if model not in MODELS:
        raise ArtifactError(
            f"{source}: model {model!r}; this softfin has {', '.join(MODELS)}; update it"
        )
    try:
        surrogate = MODELS[model].from_files(description, weights, source)
        # The channels of the paper's networks follow from the scaling.
        Limits.of(surrogate.limits.to_dict(), one_velocity=True)
        return surrogate
    except ConfigurationError as error:
        raise ArtifactError(
            f"{error}; this softfin has no such networks, so fit it again"
        ) from None
    except (KeyError, TypeError, ValueError) as error:
        reason = one_line(error)
        raise ArtifactError(
            f"{source}: not a surrogate's description ({reason}); fit it again"
        ) from None
