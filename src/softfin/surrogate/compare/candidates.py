"""The surrogates that are compared, from their folders; seeds of one configuration and dataset form a group."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfin.core.errors import ConfigurationError
from softfin.core.plant_identity import identity
from softfin.core.quantities import PAPER_LIMITS, Log
from softfin.storage import artifact as artifacts
from softfin.surrogate.store import AnySurrogate, load_surrogate

SEED_IN_NAME = re.compile(r"[-_./]?(seed)?[-_.]?\d+$")


class Candidate(NamedTuple):
    """A surrogate and where it lies."""

    folder: Path
    surrogate: AnySurrogate
    group: str
    """Key of the group: equal for seeds of one configuration on the same data."""


def candidates(folders: Sequence[Path]) -> list[Candidate]:
    """Load surrogates; raises ConfigurationError where there is none, or one is given twice."""
    if not folders:
        raise ConfigurationError("no surrogate: give the folders of those that are to be compared")
    seen: dict[str, Path] = {}
    found = []
    for folder in folders:
        surrogate = load_surrogate(folder)
        # A copy would pass for a second seed and make the interval too narrow.
        which = identity(surrogate)
        if which in seen:
            before = seen[which]
            same = "given twice" if before.resolve() == folder.resolve() else f"the same surrogate as {before}"
            raise ConfigurationError(f"{folder}: {same}; give each surrogate once")
        seen[which] = folder
        found.append(Candidate(folder, surrogate, _group(folder, surrogate)))
    return found


def names_of(groups: Sequence[Sequence[Candidate]]) -> list[str]:
    """Name each group by its model; where several are of one model, also by its first folder, less its seed."""
    models = Counter(members[0].surrogate.model for members in groups)

    def name(members: Sequence[Candidate], folder: str) -> str:
        model = members[0].surrogate.model
        common = SEED_IN_NAME.sub("", folder) if len(members) > 1 else folder
        return model if models[model] == 1 else f"{model} ({common or folder})"

    short = [name(members, members[0].folder.name) for members in groups]
    return short if len(set(short)) == len(short) else [name(each, str(each[0].folder)) for each in groups]


def beyond_limits(members: Sequence[Candidate], logs: Sequence[Log]) -> tuple[float, float]:
    """Share of the logs' commands beyond those a group was trained on, and how far the furthest is, over their range.

    For the member for which they are greatest.
    """
    commands = np.concatenate([np.stack(log.command, axis=1) for log in logs]).astype(np.float64)
    limits = np.array([member.surrogate.limits for member in members]).reshape(-1, 1, 2, 2)
    low, high = limits[..., 0], limits[..., 1]
    # Where the training commands never changed, over the range of the paper's.
    span = np.where(high > low, high - low, np.diff(np.reshape(PAPER_LIMITS, (2, 2)))[:, 0])
    excess = np.maximum((low - commands) / span, (commands - high) / span).max(axis=-1)
    return float((excess > 0).mean(axis=1).max()), max(float(excess.max()), 0.0)


def _group(folder: Path, surrogate: AnySurrogate) -> str:
    description = artifacts.load_description(folder, "surrogate")
    data = (description.get("provenance") or {}).get("data_hash")
    if description.get("configuration") is None or data is None:
        # Imported: nothing says that two such are seeds of one another.
        return str(folder.resolve())
    # The networks too: of several candidates one seed may have chosen another than the next.
    parts = [surrogate.model, description["configuration"], description.get("networks"), data]
    return json.dumps(parts, sort_keys=True)
