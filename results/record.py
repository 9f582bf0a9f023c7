"""The JSON of a part: its figures with the value of every seed, and where they come from.

A figure is ``{"unit", "summary", "seeds", "values"}``. A value is a number, null or a pair x, y.
The summary is how a document states the figure: ``mean`` with half of its 95% interval by Student's
t over the seeds, ``median`` with the minimum and maximum, or ``worst``, the maximum.
``"machine_dependent": true`` marks times, memory and rates.
"""

import json
import os
import platform
import statistics
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from results import ROOT
from results.history import describe_age
from softfin.core.window import interval

FOLDER = ROOT / "results"

Value = float | None | Sequence[float]

QUIET_CORES = 0.15
"""Cores that others may use while a step runs on a machine that counts as quiet."""

UNITS = ("s", "ms", "us", "min", "GiB", "kB", "%", "actions/s")
"""Units that are written behind a median; those of errors stand in the head of their table."""


PACKAGES = ("jax", "jaxlib", "numpy", "equinox", "optax", "softfin")
"""Packages whose versions can change a figure."""


def figure(
    unit: str,
    values: Sequence[Value],
    seeds: Sequence[int] = (),
    summary: str = "mean",
    machine_dependent: bool = False,
) -> dict[str, Any]:
    """Return a figure of a part; without seeds they are 0, 1, 2 and so on."""
    made: dict[str, Any] = {
        "unit": unit,
        "summary": summary,
        "seeds": list(seeds or range(len(values))),
        "values": list(values),
    }
    if machine_dependent:
        made["machine_dependent"] = True
    return made


def load(part: str, folder: Path = FOLDER) -> dict[str, Any]:
    """The JSON of a part."""
    record: dict[str, Any] = json.loads((folder / f"{part}.json").read_text())
    return record


def write(part: str, record: Mapping[str, Any], folder: Path = FOLDER) -> None:
    """Write the JSON of a part, a line for each figure and each step."""
    folder.mkdir(parents=True, exist_ok=True)
    nested = {key: record[key] for key in ("figures", "steps") if key in record}
    lines = [
        f"  {json.dumps(key)}: {json.dumps(value)}"
        for key, value in record.items()
        if key not in nested
    ]
    for key, value in nested.items():
        rows = ",\n".join(
            f"    {json.dumps(name)}: {json.dumps(row)}" for name, row in value.items()
        )
        lines.append(f"  {json.dumps(key)}: {{\n{rows}\n  }}")
    (folder / f"{part}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")


def machine() -> dict[str, Any]:
    """Return what this machine is."""
    processor = platform.processor()
    processor_file = Path("/proc/cpuinfo")
    if processor_file.is_file():
        for line in processor_file.read_text().splitlines():
            if line.startswith("model name"):
                processor = line.partition(": ")[2]
                break
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {
        "processor": processor,
        "cores": cores,
        "system": f"{platform.system()} {platform.machine()}",
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that can change a figure."""
    return {"python": platform.python_version(), **{name: version(name) for name in PACKAGES}}


def shown(stated: Mapping[str, Any], form: str = ".3f", summary: str | None = None) -> str:
    """The figure as a document states it, x and y apart by a slash."""
    values = [value for value in stated["values"] if value is not None]
    summary = summary or stated["summary"]
    if not values:
        return "\N{EN DASH}"
    if len(values) < len(stated["values"]):
        # A force that never settles, a search that finds nothing: no mean or median of the others
        # stands for it.
        return f"not in {len(stated['values']) - len(values)} of {len(stated['values'])}"
    axes = np.atleast_2d(np.asarray(values, float).T)
    unit = f" {stated['unit']}" if summary == "median" and stated["unit"] in UNITS else ""
    return " / ".join(_summed(axis, form, summary) for axis in axes) + unit


def _summed(values: np.ndarray, form: str, summary: str) -> str:
    if summary == "worst":
        return format(values.max(), form)
    if summary == "median":
        least, middle, most = (
            format(x, form)
            for x in (values.min(), statistics.median(values.tolist()), values.max())
        )
        return middle if least == most else f"{middle} ({least} to {most})"
    mean = format(values.mean(), form)
    between = interval(values)
    if summary == "plain" or np.allclose(values, values[0], rtol=0, atol=1e-12):
        return mean
    if between is None:
        # Two values have no interval that tells anything.
        return " and ".join(format(value, form) for value in values)
    half = (between[1] - between[0]) / 2
    return f"{mean} \N{PLUS-MINUS SIGN} {format(half, form)}"


def short_source(part: str, record: Mapping[str, Any]) -> str:
    """Return the file, seeds and date of the figures of a part, for the line below a table."""
    return f"`{part}.json` ({count_seeds(record)}, {record['date']})"


def count_seeds(record: Mapping[str, Any]) -> str:
    """Return the number of seeds of the figures of a part, such as ``5 seeds``."""
    num_seeds = max(len(each["values"]) for each in record["figures"].values())
    return f"{num_seeds} seed{'s' if num_seeds > 1 else ''}"


def source(part: str, record: Mapping[str, Any]) -> str:
    """Return where the figures of a part come from: its file, commits, date, seeds, machine and
    age."""
    commits = ", ".join(record["commits"])
    commits = f"commit{'s' if len(record['commits']) > 1 else ''} {commits}"
    steps = record["steps"].values()
    if any(step["changed"] for step in steps):
        commits += " with uncommitted changes"
    seeds = count_seeds(record)
    machine = f"{record['machine']['processor']} with {record['machine']['cores']} cores"
    busy_cores = max((step["others_cores"] or 0.0 for step in steps), default=0.0)
    load = (
        "quiet"
        if busy_cores <= QUIET_CORES
        else f"other programs used up to {busy_cores:.1f} cores"
    )
    age = describe_age(record["commits"])
    return f"`results/{part}.json` ({commits}; {record['date']}; {seeds}; {machine}, {load}; {age})"
