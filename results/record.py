"""The JSON of a part: figures with the value of every seed, and where they come from.

A figure is ``{"unit", "summary", "seeds", "values"}``; a value is a number, null, or a pair x, y. The summary says how
a document states it: ``mean`` with half of its 95% interval by Student's t over the seeds, ``median`` with the least
and the greatest (of times), or ``worst``, the greatest. Figures that were stated before there were such files, and have
not been run since, are ``{"text", "seeds"}``, with the number of seeds where it is known.
"""

import json
import math
import os
import platform
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from results import ROOT
from softfin.core.window import interval

FOLDER = ROOT / "results"

Value = float | None | Sequence[float]

QUIET_CORES = 0.15
"""Cores that others may use while a step runs on a machine that counts as quiet."""

UNITS = ("s", "ms", "us", "min", "GiB", "kB", "%", "actions/s")
"""Units that are written behind a median; those of errors stand in the head of their table."""


def figure(unit: str, values: Sequence[Value], seeds: Sequence[int] = (), summary: str = "mean") -> dict[str, Any]:
    """A figure of a part; without seeds it is of the first so many."""
    return {"unit": unit, "summary": summary, "seeds": list(seeds or range(len(values))), "values": list(values)}


def load(part: str, folder: Path = FOLDER) -> dict[str, Any]:
    """The JSON of a part."""
    record: dict[str, Any] = json.loads((folder / f"{part}.json").read_text())
    return record


def write(part: str, record: Mapping[str, Any], folder: Path = FOLDER) -> None:
    """Write the JSON of a part, a line for each figure and each step."""
    folder.mkdir(parents=True, exist_ok=True)
    nested = {key: record[key] for key in ("figures", "steps", "pictures") if key in record}
    lines = [f"  {json.dumps(key)}: {json.dumps(value)}" for key, value in record.items() if key not in nested]
    for key, value in nested.items():
        rows = ",\n".join(f"    {json.dumps(name)}: {json.dumps(row)}" for name, row in value.items())
        lines.append(f"  {json.dumps(key)}: {{\n{rows}\n  }}")
    (folder / f"{part}.json").write_text("{\n" + ",\n".join(lines) + "\n}\n")


def machine() -> dict[str, Any]:
    """The machine, in words of its own."""
    info = Path("/proc/cpuinfo")
    names = (
        [line.partition(": ")[2] for line in info.read_text().splitlines() if line.startswith("model name")]
        if (info.is_file())
        else []
    )
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
    }


def shown(stated: Mapping[str, Any], form: str = ".3f", summary: str | None = None) -> str:
    """The figure as a document states it, x and y apart by a slash."""
    if "text" in stated:
        return re.sub(" \N{PLUS-MINUS SIGN} [0-9.]+", "", stated["text"]) if summary == "plain" else stated["text"]
    values, summary = [value for value in stated["values"] if value is not None], summary or stated["summary"]
    if not values:
        return "\N{EN DASH}"
    if len(values) < len(stated["values"]):
        # A force that never settles, a search that finds nothing: no mean or median of the others stands for it.
        return f"not in {len(stated['values']) - len(values)} of {len(stated['values'])}"
    axes = np.atleast_2d(np.asarray(values, float).T)
    unit = f" {stated['unit']}" if summary == "median" and stated["unit"] in UNITS else ""
    return " / ".join(_summed(axis, form, summary) for axis in axes) + unit


def _summed(values: np.ndarray, form: str, summary: str) -> str:
    if summary == "worst":
        return format(values.max(), form)
    if summary == "median":
        least, middle, most = (
            format(x, form) for x in (values.min(), statistics.median(values.tolist()), values.max())
        )
        return middle if least == most else f"{middle} ({least} to {most})"
    mean, between = format(values.mean(), form), interval(values)
    if summary == "plain" or len(values) == 1:
        return mean
    if len(values) == 2 or between is None:
        # Two values have no interval that tells anything.
        return " and ".join(format(value, form) for value in values)
    half = (between[1] - between[0]) / 2
    return mean if math.isclose(half, 0, abs_tol=1e-12) else f"{mean} \N{PLUS-MINUS SIGN} {format(half, form)}"


def source(part: str, record: Mapping[str, Any]) -> str:
    """Where the figures of a part come from, and on what machine they were measured."""
    note = f"; {record['note']}" if record.get("note") else ""
    skipped = f"; not run here: {record['skipped']}" if record.get("skipped") else ""
    if "steps" not in record:
        return f"`results/{part}.json` (not run yet, carried over from commit {record['carried_over']}{note}{skipped})"
    seeds = max(len(each["values"]) for each in record["figures"].values())
    busy = max((step["others_cores"] or 0.0 for step in record["steps"].values()), default=0.0)
    load = "quiet" if busy <= QUIET_CORES else f"others used up to {busy:.1f} of them"
    changed = " with changes" if any(step["changed"] for step in record["steps"].values()) else ""
    return (
        f"`results/{part}.json` (commit {record['commit']}{changed}, {record['date']}, "
        f"{seeds} seed{'s' if seeds > 1 else ''}, {record['machine']['cores']} cores, {load}{note})"
    )
