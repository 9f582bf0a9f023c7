"""The command line: ``softfin COMMAND ...``; each command is a module of this folder, imported when it is called."""

import contextlib
import importlib
import importlib.metadata
import io
import os
import re
import sys
from collections.abc import Sequence
from typing import Any

from softfin.printable import printable

COMMANDS = {
    "collect": "record motions of a fin, random or chosen by a surrogate, and its force as a dataset",
    "inspect": "say what is wrong with logs, before anyone trains on them",
    "import-logs": "turn CSV, Parquet or ROS 2 bags into a dataset",
    "fit": "learn a surrogate from logs: streaming nets, the paper's nets, or the better ones",
    "calibrate": "fit the virtual tank to logs or to a plant",
    "import-keras": "turn published .keras nets and their scalers into a surrogate",
    "compare": "score surrogates on unseen logs, left alone for several horizons",
    "map": "which mean forces can this fin make, and at what cost?",
    "train": "train force controllers inside a surrogate: by gradients, by LSTM-PPO, or gaits",
    "evaluate": "judge a controller on a fin over reference forces",
    "baselines": "judge what needs no learnt controller: best sine, analytic inverse model, random search",
    "view": "show a fin in motion, as a film or as a page that plays it",
    "rig": "the real fin: check it, zero it, or emulate its drive and sensor",
    "run": "hold reference forces on the real fin",
    "bag": "mend a recording that was cut off; turn recordings into logs and back",
    "monitor": "watch a recording while it is made, in the terminal or as a page",
    "ros2": "run as a ROS 2 node: readings out, references in",
    "export": "write a controller as ONNX, for hosts without Python",
    "reproduce": "all of it in one run, with the paper's tables and figures",
}

SEEDS = 2**31
"""How many there are: what every generator of random numbers takes."""

STOPPED = 1
"""Exit code after Ctrl-C: a failure midway."""


def script() -> None:
    """What the installed command calls: `main`, and an end at once after Ctrl-C.

    An interpreter that shuts down beside a compiled program that Ctrl-C has left running may crash, after all is said.
    """
    try:
        main()
    except _Interrupted as stop:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(int(stop.code or STOPPED))


class _Interrupted(SystemExit):
    """After Ctrl-C."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit code 0, 1 for a failure midway, 2 for input that cannot be used."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    name = words[0] if words else "--help"
    if name in ("-h", "--help"):
        sys.stdout.write(_usage() + "\n")
    elif name in ("-V", "--version"):
        sys.stdout.write(f"softfin {importlib.metadata.version('softfin')}\n")
    elif name not in COMMANDS:
        _exit(f"softfin: unknown command {name!r}; there are {', '.join(COMMANDS)}", 2)
    else:
        _run(name, words[1:])


def _run(name: str, words: list[str]) -> None:
    debug = "--debug" in words
    # The readers of these lines want theirs, not XLA's notes on how it compiles.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        command = _parse(name, importlib.import_module(f"softfin.cli.{name.replace('-', '_')}").Arguments, words)
        seed = getattr(command, "seed", None)
        if seed is not None and not 0 <= seed < SEEDS:
            _exit(f"softfin {name}: --seed {seed}: a seed is a whole number from 0 to {SEEDS - 1}", 2)
        command.run()
    except KeyboardInterrupt:
        if debug:
            raise
        hint = "; the same command with --resume goes on" if "resume" in _options(name) else ""
        sys.stderr.write(f"softfin {name}: stopped, nothing is half-written{hint}\n")
        raise _Interrupted(STOPPED) from None
    except Exception as error:
        from softfin.errors import SoftfinError

        if debug:
            raise
        if isinstance(error, SoftfinError):
            _exit(f"softfin {name}: {error}", error.exit_code)
        if isinstance(error, OSError):
            _exit(f"softfin {name}: {error.filename or 'system'}: {error.strerror or error}", STOPPED)
        _exit(f"softfin {name}: {type(error).__name__}: {' '.join(str(error).split())[:500]} "
              "(this should not happen; --debug shows where)", STOPPED)  # fmt: skip


def _parse(name: str, arguments: type[Any], words: list[str]) -> Any:
    import tyro

    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(arguments, prog=f"softfin {name}", args=words, config=(tyro.conf.FlagCreatePairsOff,))
    except SystemExit as stop:
        if stop.code:
            _exit(f"softfin {name}: {_one_line(complaint.getvalue())}", 2)
        raise


def _one_line(box: str) -> str:
    """The words of tyro's framed complaint, up to its help for the option."""
    lines = [re.sub(r"^[╭╰│─\s]+|[╮╯│─\s]+$", "", line) for line in re.sub(r"\x1b\[[0-9;]*m", "", box).splitlines()]
    words = [line for line in lines[1:] if line]
    useful = []
    for line in words:
        if line.startswith(("Argument helptext", "For full helptext")):
            break
        useful.append(line)
    return " ".join(useful) + "; see --help"


def _options(name: str) -> set[str]:
    import dataclasses

    module = importlib.import_module(f"softfin.cli.{name.replace('-', '_')}")
    return {field.name for field in dataclasses.fields(module.Arguments)}


def _usage() -> str:
    width = max(map(len, COMMANDS))
    lines = [f"  {name:{width}}  {what}" for name, what in COMMANDS.items()]
    head = ["usage: softfin COMMAND [OPTION ...]", "", "Learn to make the force that you ask a soft fin for.", ""]
    foot = ["", "softfin COMMAND --help tells a command's options; --debug shows tracebacks."]
    return "\n".join([*head, *lines, *foot])


def _exit(message: str, code: int) -> None:
    # Of a terminal that was closed nothing is left to write to; the code still counts.
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(message) + "\n")
        sys.stderr.flush()
    raise SystemExit(code)
