"""A surrogate's folder: ``surrogate.json`` (networks, scaling, scores, provenance) and ``weights.safetensors``."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from softfin.core.errors import ArtifactError
from softfin.core.quantities import RATE_HZ, Limits
from softfin.storage import artifact as artifacts
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.network import Network, NetworkConfig
from softfin.surrogate.paper.posnet import COMMANDS
from softfin.surrogate.paper.scaling import Scaling
from softfin.surrogate.paper.surrogate import ANGLE, Surrogate
from softfin.surrogate.streaming.files import read_streaming, streaming_described
from softfin.surrogate.streaming.streaming import StreamingSurrogate

KIND = "surrogate"
FORMAT = 1


AnySurrogate: TypeAlias = Surrogate | StreamingSurrogate


def save_surrogate(
    path: Path,
    surrogate: AnySurrogate,
    scores: dict[str, Any] | None,
    provenance: dict[str, Any],
    also: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    **facts: Any,
) -> None:
    """Write the folder, whole or not at all; `also` adds files to it, `facts` are further entries of the JSON."""
    described, weights = (
        streaming_described(surrogate) if isinstance(surrogate, StreamingSurrogate) else _paper_described(surrogate)
    )
    description = {
        "kind": KIND,
        "format": FORMAT,
        "model": surrogate.model,
        "rate_hz": RATE_HZ,
        "limits": surrogate.limits.described(),
        **described,
        "scores": scores,
        **facts,
        "provenance": provenance,
    }
    artifacts.save(path, KIND, description, weights, also, overwrite)


def load_surrogate(path: Path) -> AnySurrogate:
    """The surrogate in a folder; raises ArtifactError where it is none, damaged, or of another rate or channels."""
    description, weights = artifacts.load(path, KIND)
    source = str(path / f"{KIND}.json")
    if description.get("format", FORMAT) != FORMAT:
        raise ArtifactError(f"{source}: format {description['format']}; this softfin reads {FORMAT}; update it")
    if description.get("rate_hz") != RATE_HZ:
        raise ArtifactError(f"{source}: made for {description.get('rate_hz')} Hz; softfin runs at {RATE_HZ} Hz")
    # Those that were written before there was another kind do not say which they are.
    model = description.get("model", "paper")
    if model not in _READERS:
        raise ArtifactError(f"{source}: model {model!r}; this softfin knows {', '.join(_READERS)}; update it")
    try:
        surrogate = _READERS[model](description, weights, source)
        # Of the paper's nets they follow from the scaling.
        Limits.of(surrogate.limits.described(), one_velocity=True)
        return surrogate
    except (KeyError, TypeError, ValueError) as error:
        raise ArtifactError(f"{source}: not a surrogate's description ({' '.join(str(error).split())})") from None


def _paper_described(surrogate: Surrogate) -> tuple[dict[str, Any], dict[str, Any]]:
    nets = {"posnet": surrogate.posnet, "forcenet": surrogate.forcenet}
    weights = {f"{name}.{key}": array for name, net in nets.items() for key, array in net.arrays().items()}
    return {
        "networks": {name: net.config.model_dump(mode="json") for name, net in nets.items()},
        "parameters": {name: net.config.parameters() for name, net in nets.items()},
        "scaling": surrogate.scaling.model_dump(mode="json")["channels"],
    }, weights


def _read_paper(description: dict[str, Any], weights: dict[str, Any], source: str) -> Surrogate:
    configs = {name: NetworkConfig.model_validate(description["networks"][name]) for name in ("posnet", "forcenet")}
    scaling = Scaling(channels=description["scaling"])
    scaling.require([ANGLE, *COMMANDS, *FORCES], source)
    networks = {name: Network.of(config, _of_net(name, weights), source) for name, config in configs.items()}
    return Surrogate(networks["posnet"], networks["forcenet"], scaling)


def _of_net(name: str, weights: dict[str, Any]) -> dict[str, Any]:
    return {key.partition(".")[2]: array for key, array in weights.items() if key.startswith(f"{name}.")}


_READERS: dict[str, Callable[[dict[str, Any], dict[str, Any], str], AnySurrogate]] = {
    "paper": _read_paper,
    "streaming": read_streaming,
}
