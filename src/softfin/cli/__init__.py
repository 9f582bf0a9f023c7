"""The command line: ``softfin COMMAND ...``; the module of a command is imported when the command
is called."""

import contextlib
import difflib
import gc
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from softfin.core.printable import printable
from softfin.core.program_cache import describe_cache, use_program_cache


class Command(NamedTuple):
    """A command in the list of commands."""

    module: str
    """Module of this folder with its options."""
    summary: str
    """Description in the list of commands."""


GROUPS = {
    "Start": {
        "demo": Command("reproduce", "run every stage on a simulated fin and write a report"),
        "example": Command("example", "write a trained surrogate, controllers and a recording"),
        "doctor": Command("doctor", "check this computer and the installation"),
    },
    "Data": {
        "collect": Command("data", "record random motions of a fin and its force as a dataset"),
        "inspect": Command("data", "check logs before you fit a surrogate to them"),
        "import-logs": Command("data", "convert CSV, Parquet or ROS 2 bags into a dataset"),
        "bag recover": Command("data", "recover the readings of a damaged recording"),
        "bag convert": Command("data", "convert recordings to Parquet or ROS 2 bags"),
    },
    "Model": {
        "fit": Command("surrogates", "fit a surrogate model of the fin to logs"),
        "compare": Command("surrogates", "score surrogates on test logs"),
        "calibrate": Command("surrogates", "fit the virtual tank to logs or to a plant"),
        "import-keras": Command("surrogates", "convert published .keras networks to a surrogate"),
    },
    "Controllers": {
        "map": Command("controllers", "find the mean forces that a fin can produce"),
        "train": Command("controllers", "train force controllers inside a surrogate"),
        "evaluate": Command("evaluation", "evaluate a controller on a fin over reference forces"),
        "baselines": Command("evaluation", "evaluate baselines that need no training"),
        "view": Command("evaluation", "animate a fin as a GIF, an HTML page or a picture"),
        "explore": Command("evaluation", "write a page to try controllers in the browser"),
        "export": Command("controllers", "write a controller or a surrogate as ONNX"),
    },
    "Rig": {
        "rig check": Command("rig", "check drive, sensor and settings; nothing moves"),
        "rig zero": Command("rig", "set the angle and the force to zero"),
        "rig commission": Command("rig", "run the acceptance steps of a new rig"),
        "rig stop": Command("rig", "stop the motor and switch it off"),
        "rig emulate": Command("rig", "emulate a rig without hardware"),
        "run": Command("driving", "hold reference forces on the real fin"),
        "monitor": Command("rig", "watch a recording in progress"),
        "ros2": Command("driving", "hold the reference forces of a ROS 2 topic on the real fin"),
    },
    "Robots": {
        "robot check": Command("robot", "check what a robot with several fins can do"),
        "robot evaluate": Command("robot", "evaluate how a robot keeps its place and its path"),
        "robot view": Command("robot", "show one trial as a page in three dimensions"),
        "robot ros2": Command("robot", "share body wrenches among fins, as a ROS 2 node"),
    },
    "Paper": {
        "reproduce": Command("reproduce", "run every stage of the paper, with its tables"),
    },
}
"""The commands by topic."""

COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}

STOPPED = 1
"""Exit code after Ctrl-C, as for a failure midway."""


def script() -> None:
    """Run `main` as the installed command; after Ctrl-C end at once, because a compiled program may
    still run."""
    use_program_cache()
    try:
        main()
    except SystemExit as stop:
        if not isinstance(stop.__cause__, KeyboardInterrupt):
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(STOPPED)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command; exit code 0, 1 for a failure midway, 2 for input that cannot be used."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    first = words[0] if words else "--help"
    if first in ("-h", "--help"):
        sys.stdout.write(_usage() + "\n")
    elif first in ("-V", "--version"):
        sys.stdout.write(f"softfin {importlib.metadata.version('softfin')}\n")
    elif first in COMMANDS:
        _run(first, words[1:])
    elif actions := list_actions(first):
        _run_action(first, actions, words[1:])
    else:
        names = tuple(dict.fromkeys(name.split()[0] for name in COMMANDS))
        _exit(f"softfin: unknown command {first!r}; use {_choices(first, names)}", 2)


def list_actions(name: str) -> tuple[str, ...]:
    """List the second words of a command, such as recover and convert of bag."""
    return tuple(each.split()[1] for each in COMMANDS if each.startswith(f"{name} "))


def _run_action(name: str, actions: tuple[str, ...], words: list[str]) -> None:
    action = words[0] if words else "--help"
    if action in ("-h", "--help"):
        group = {each: COMMANDS[each] for each in (f"{name} {action}" for action in actions)}
        sys.stdout.write(f"usage: softfin {name} ACTION [OPTION ...]\n\n{_list(group)}\n")
    elif action in actions:
        _run(f"{name} {action}", words[1:])
    else:
        _exit(f"softfin {name}: unknown action {action!r}; use {_choices(action, actions)}", 2)


def _choices(word: str, allowed: tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, allowed, n=1)
    return ", ".join(allowed) + (f"; did you mean {close[0]}?" if close else "")


def import_arguments(name: str) -> type[Any]:
    """Import the class of a command, such as `RigCheckArguments`, whose fields are its options."""
    module = importlib.import_module(f"softfin.cli.{COMMANDS[name].module}")
    words = name.replace("-", " ").split()
    arguments: type[Any] = getattr(module, "".join(map(str.capitalize, words)) + "Arguments")
    return arguments


def _run(name: str, words: list[str]) -> None:
    # Imported here: --version needs none of it.
    from softfin.installation import what_is_missing

    debug = "--debug" in words
    try:
        from softfin.cli import options
    except ModuleNotFoundError as error:
        if debug or (missing := what_is_missing(error)) is None:
            raise
        _exit(f"softfin {name}: {missing}", 2)
    _configure_process()
    arguments: Any = None
    try:
        arguments = import_arguments(name)
        command = options.parse(arguments, words)
        command.check()
        command()
    except options.HelpRequested:
        sys.stdout.write(options.format_help(arguments, f"softfin {name}") + "\n")
        raise SystemExit(0) from None
    except KeyboardInterrupt as interrupt:
        if debug:
            raise
        hint = (
            "; add --resume to continue"
            if "resume" in getattr(arguments, "model_fields", ())
            else ""
        )
        sys.stderr.write(f"softfin {name}: stopped; no file is half-written{hint}\n")
        raise SystemExit(STOPPED) from interrupt
    except Exception as error:
        if debug:
            raise
        message, code = _describe_error(error)
        _exit(f"softfin {name}: {message}", code)


def _configure_process() -> None:
    """Set what NumPy, JAX and XLA read when they are imported."""
    # XLA's notes about compilation would hide the lines of a command.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # Threads of OpenBLAS spin while they wait for each other: next to other work, sums that take
    # NumPy 0.1 s of processor time on one thread took from 9 s to a minute.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # JAX creates millions of small objects while it traces; collecting garbage at the default rate
    # takes a sixth of that time.
    gc.set_threshold(50_000, 20, 10)


def _describe_error(error: Exception) -> tuple[str, int]:
    """Return a one-line message for an error, and its exit code."""
    from softfin.core.errors import SoftfinError, one_line
    from softfin.installation import what_is_missing

    if isinstance(error, SoftfinError):
        return str(error), error.exit_code
    if isinstance(error, ModuleNotFoundError) and (missing := what_is_missing(error)) is not None:
        return missing, 2
    if isinstance(error, OSError):
        return f"{error.filename or 'system'}: {error.strerror or error}", STOPPED
    text = f"{type(error).__name__}: {one_line(error)}"
    return f"{text} (this should not happen; --debug shows where)", STOPPED


def _list(commands: Mapping[str, Command]) -> str:
    return "\n".join(f"  {name:14}  {command.summary}" for name, command in commands.items())


def _usage() -> str:
    groups = "\n\n".join(f"{title}:\n{_list(commands)}" for title, commands in GROUPS.items())
    return (
        "usage: softfin COMMAND [OPTION ...]\n\nMake a soft fin produce the force you ask for.\n\n"
        f"{groups}\n\nsoftfin COMMAND --help lists the options of a command; --debug shows "
        f"tracebacks; softfin --version prints the version.\n{describe_cache()}"
    )


def _exit(message: str, code: int) -> None:
    # A closed terminal cannot be written to, but the exit code still counts.
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(message) + "\n")
        sys.stderr.flush()
    raise SystemExit(code)
