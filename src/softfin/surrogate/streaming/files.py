"""What stands of a streaming surrogate in its folder: configuration as JSON, arrays by their place in the nets."""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from softfin.core.errors import ArtifactError
from softfin.core.quantities import Limits
from softfin.surrogate.paper.forcenet import FORCES
from softfin.surrogate.paper.posnet import COMMANDS
from softfin.surrogate.streaming.drive import DriveNetConfig
from softfin.surrogate.streaming.force import ForceNetConfig, Motion, Scales
from softfin.surrogate.streaming.member import ensemble, single
from softfin.surrogate.streaming.profile import ProfileConfig
from softfin.surrogate.streaming.streaming import StreamingSurrogate
from softfin.surrogate.streaming.uncertainty import Familiarity, Interval, remembered

CHANNELS = {"in": list(COMMANDS), "out": ["angle_rad", "velocity_rad_s", *FORCES]}

Tree = TypeVar("Tree")


def streaming_described(surrogate: StreamingSurrogate) -> tuple[dict[str, Any], dict[str, Any]]:
    """Entries of ``surrogate.json``, and the arrays by name."""
    drive, force = surrogate.members.drive, surrogate.members.force
    described = {
        "channels": CHANNELS,
        "members": surrogate.size,
        "networks": {"drive": drive.config.model_dump(mode="json"), "force": force.config.model_dump(mode="json")},
        "scales": force.scales.model_dump(mode="json"),
        "interval": surrogate.interval.model_dump(mode="json"),
        "parameters": surrogate.parameters(),
    }
    return described, _named(surrogate.members, "members") | _named(surrogate.familiarity, "familiarity")


def read_streaming(description: dict[str, Any], weights: dict[str, Any], source: str) -> StreamingSurrogate:
    """The surrogate again; raises ArtifactError where channels or arrays are not what its configuration says."""
    if description["channels"] != CHANNELS:
        raise ArtifactError(f"{source}: channels {description['channels']}; softfin steps surrogates with {CHANNELS}")
    drive = DriveNetConfig.model_validate(description["networks"]["drive"])
    force = ForceNetConfig.model_validate(description["networks"]["force"])
    scales = Scales.model_validate(description["scales"])
    key = jax.random.key(0)
    skeleton = eqx.filter_eval_shape(
        lambda: ensemble(int(description["members"]), drive, force, ProfileConfig(), scales, key)
    )
    members = _filled(skeleton, "members", weights, source)
    still = Motion(jnp.zeros(()), jnp.zeros(()))
    size = remembered(single(members.force).start(still)).size
    shapes = eqx.filter_eval_shape(lambda: Familiarity(jnp.zeros(size), jnp.zeros((size, size))))
    return StreamingSurrogate(
        members,
        Limits.of(description["limits"], one_velocity=True),
        Interval.model_validate(description["interval"]),
        _filled(shapes, "familiarity", weights, source),
    )


def _named(tree: Any, prefix: str) -> dict[str, Any]:
    return {_name(prefix, path): np.asarray(leaf) for path, leaf in jax.tree_util.tree_leaves_with_path(tree)}


def _name(prefix: str, path: Any) -> str:
    return f"{prefix}.{jax.tree_util.keystr(path, simple=True, separator='.')}"


def _filled(skeleton: Tree, prefix: str, weights: dict[str, Any], source: str) -> Tree:
    def leaf(path: Any, shape: Any) -> Any:
        name = _name(prefix, path)
        found = weights.get(name)
        if found is None or found.shape != shape.shape:
            held = "is missing" if found is None else f"has the shape {found.shape}"
            raise ArtifactError(f"{source}: {name} {held}, must have {shape.shape}; copy the whole folder again")
        return jnp.asarray(found)

    filled: Tree = jax.tree_util.tree_map_with_path(leaf, skeleton)
    return filled
