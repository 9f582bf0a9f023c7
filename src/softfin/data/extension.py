"""Recording on: a dataset of some plant in, what another one needs to take its logs over out."""

from pathlib import Path
from typing import Any

from softfin.core.errors import ConfigurationError
from softfin.storage.dataset import Dataset


def extended(path: Path, facts: dict[str, Any]) -> Dataset:
    """The dataset at `path`, recorded from the plant that `facts` tell of by ``plant`` and ``plant_identity``.

    Raises:
        ArtifactError: it is no dataset, or damaged.
        ConfigurationError: it is of another plant, or does not say of which.
    """
    before = Dataset.open(path)
    known, now = before.description, str(facts["plant"])
    plant, which = known.get("plant"), known.get("plant_identity")
    if plant is None:
        raise ConfigurationError(
            f"{path}: its dataset.json does not say of which plant it is, so nothing is added to it; "
            f'if it is of {now}, write "plant": "{now}" into it'
        )
    # Names may differ for one plant, and one name, as that of a file, may come to stand for another.
    if which != facts["plant_identity"] if which is not None else plant != now:
        changed = f"{now}, but that has changed since" if plant == now else f"{plant}, not of {now}"
        raise ConfigurationError(f"{path}: recorded of {changed}; logs of two plants do not mix: collect anew")
    return before


def extension(before: Dataset) -> dict[str, Any]:
    """What a dataset says of the one that it took over: how many logs, and all that was known of them but the files."""
    known = {name: value for name, value in before.description.items() if name not in ("files", "data_hash")}
    counts = {"logs": len(before.train), "test_logs": len(before.test)}
    return {"dataset": str(before.path), "data_hash": before.data_hash, **counts, "description": known}
