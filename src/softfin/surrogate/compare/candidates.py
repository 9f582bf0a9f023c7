"""What is compared: surrogates from their folders, those that are seeds of one configuration told from the others."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from softfin.core.errors import ConfigurationError
from softfin.core.plant_identity import identity
from softfin.core.quantities import PAPER_LIMITS, Limits, Log
from softfin.storage import artifact as artifacts
from softfin.surrogate import load_surrogate
from softfin.surrogate.compare.horizons import FreeRunner

SEED_IN_NAME = re.compile(r"[-_./]?(seed)?[-_.]?\d+$")


class Candidate(NamedTuple):
    """A surrogate and where it lies."""

    folder: Path
    surrogate: FreeRunner
    group: str
    """Equal for seeds of one configuration on the same data."""


def candidates(folders: Sequence[Path]) -> list[Candidate]:
    """Load surrogates; raises ConfigurationError where one is given twice, under one name or two."""
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
    """Of groups: the model; where several groups are of one, with the name of the first folder, less its seed."""
    models = Counter(members[0].surrogate.model for members in groups)

    def name(members: Sequence[Candidate], whole: bool) -> str:
        model = members[0].surrogate.model
        if models[model] == 1:
            return model
        folders = [str(member.folder) if whole else member.folder.name for member in members]
        common = SEED_IN_NAME.sub("", folders[0]) if len(folders) > 1 else folders[0]
        return f"{model} ({common or folders[0]})"

    short = [name(members, whole=False) for members in groups]
    return short if len(set(short)) == len(short) else [name(members, whole=True) for members in groups]


def beyond_limits(members: Sequence[Candidate], logs: Sequence[Log]) -> tuple[float, float]:
    """Share of the logs' commands beyond those a group was trained on, and how far the furthest is, over their range.

    Of the member for which they are greatest.
    """
    each = [_beyond(member.surrogate.limits, logs) for member in members]
    return max(share for share, _ in each), max(furthest for _, furthest in each)


def _beyond(limits: Limits, logs: Sequence[Log]) -> tuple[float, float]:
    excess = []
    # Where the training commands never changed, over the range of the paper's.
    paper = PAPER_LIMITS
    for field, low, high, usual in (
        ("angle", limits.angle_min, limits.angle_max, paper.angle_max - paper.angle_min),
        ("velocity", limits.velocity_min, limits.velocity_max, paper.velocity_max - paper.velocity_min),
    ):
        values = np.concatenate([np.asarray(getattr(log.command, field), np.float64) for log in logs])
        excess.append(np.maximum(np.maximum(low - values, values - high) / (high - low or usual), 0))
    most = np.max(excess, axis=0)
    return float(np.mean(most > 0)), float(most.max())


def _group(folder: Path, surrogate: FreeRunner) -> str:
    description = artifacts.load_description(folder, "surrogate")
    data = (description.get("provenance") or {}).get("data_hash")
    if description.get("configuration") is None or data is None:
        # Imported: nothing says that two such are seeds of one another.
        return str(folder.resolve())
    # The networks too: of several candidates one seed may have chosen another than the next.
    facts = [surrogate.model, description["configuration"], description.get("networks"), data]
    return json.dumps(facts, sort_keys=True)
