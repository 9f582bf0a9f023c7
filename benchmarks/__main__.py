"""``python -m benchmarks [NAME ...]``: all figures, or some, as JSON on standard output."""

import importlib
import json
import sys

from softfin.core.program_cache import use_program_cache

NAMES = (
    "tank",
    "task",
    "surrogate",
    "fit",
    "ppo",
    "controllers",
    "cells",
    "compile",
    "memory",
    "logs",
    "controller_step",
    "recording",
    "rig",
    "rig_deaths",
    "activation",
    "robot",
    "explore",
)


def main() -> None:
    use_program_cache()
    rows = []
    for name in sys.argv[1:] or NAMES:
        sys.stderr.write(f"{name} ...\n")
        rows += importlib.import_module(f"benchmarks.{name}").main()
    print(json.dumps(rows, indent=2))


main()
