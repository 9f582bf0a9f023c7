"""The command line: ``softfin COMMAND ...``; a command's module in this folder is imported when it
is called."""

import contextlib
import difflib
import gc
import importlib
import importlib.metadata
import os
import sys
from collections.abc import Sequence
from typing import Any

from softfin.core.printable import printable
from softfin.core.program_cache import describe_cache, use_program_cache

COMMANDS = {
    "example": (
        "example",
        "write an example to begin with: a trained surrogate, controllers, a recording",
    ),
    "collect": (
        "data",
        "record motions of a fin, random or chosen by a surrogate, and its force as a dataset",
    ),
    "inspect": ("data", "check logs before a surrogate is fitted to them"),
    "import-logs": ("data", "turn CSV, Parquet or ROS 2 bags into a dataset"),
    "fit": (
        "surrogates",
        "fit a surrogate to logs: streaming networks, the paper's networks, or the better of both",
    ),
    "calibrate": ("surrogates", "fit the virtual tank to logs or to a plant"),
    "import-keras": (
        "surrogates",
        "turn published .keras networks and their scalers into a surrogate",
    ),
    "compare": ("surrogates", "score surrogates on test logs, free-running over several horizons"),
    "map": ("controllers", "find the mean forces that a fin can make, and gaits that make them"),
    "train": (
        "controllers",
        "train force controllers inside a surrogate: by gradients, by LSTM-PPO, or gaits",
    ),
    "evaluate": ("evaluation", "evaluate a controller on a fin over reference forces"),
    "baselines": (
        "evaluation",
        "evaluate baselines without learning: best sine, analytic model, random search",
    ),
    "view": ("evaluation", "show a fin in motion, as a film or as a page that plays it"),
    "explore": (
        "evaluation",
        "make a page in which one drags the force and watches the fin hold it",
    ),
    "rig": ("rig", "the real fin: check it, zero it, or emulate its drive and sensor"),
    "run": ("driving", "hold reference forces on the real fin"),
    "bag": ("data", "recover a recording that was cut off; convert recordings to logs and back"),
    "monitor": ("rig", "watch a recording while it is made, in the terminal or as a page"),
    "ros2": ("driving", "run as a ROS 2 node: readings out, references in"),
    "robot": (
        "robot",
        "a robot with several fins: what it can do, how it holds its place and follows a path",
    ),
    "export": (
        "controllers",
        "write a controller or a surrogate as ONNX, for hosts without Python",
    ),
    "doctor": (
        "doctor",
        "examine this computer and the installation: what is well, what is not, what to do",
    ),
    "reproduce": ("evaluation", "run all stages, with the paper's tables and figures"),
}
"""For each command its module, and what it does."""

STOPPED = 1
"""Exit code after Ctrl-C: a failure midway."""


def script() -> None:
    """Run `main` as the installed command; after Ctrl-C end at once, as a compiled program may
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
    name = words[0] if words else "--help"
    if name in ("-h", "--help"):
        sys.stdout.write(_usage() + "\n")
    elif name in ("-V", "--version"):
        sys.stdout.write(f"softfin {importlib.metadata.version('softfin')}\n")
    elif name not in COMMANDS:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        _exit(f"softfin: unknown command {name!r}; there are {', '.join(COMMANDS)}{hint}", 2)
    else:
        _run(name, words[1:])


def import_arguments(name: str) -> type[Any]:
    """Import the class of a command, such as `ImportLogsArguments`, whose fields are its
    options."""
    module = importlib.import_module(f"softfin.cli.{COMMANDS[name][0]}")
    arguments: type[Any] = getattr(
        module, "".join(map(str.capitalize, name.split("-"))) + "Arguments"
    )
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
            "; the same command with --resume goes on"
            if "resume" in getattr(arguments, "model_fields", ())
            else ""
        )
        sys.stderr.write(f"softfin {name}: stopped, nothing is half-written{hint}\n")
        raise SystemExit(STOPPED) from interrupt
    except Exception as error:
        if debug:
            raise
        message, code = _describe_error(error)
        _exit(f"softfin {name}: {message}", code)


def _configure_process() -> None:
    """Set what NumPy, JAX and XLA read when they are imported."""
    # XLA's notes on how it compiles would hide the lines of a command.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # Threads of OpenBLAS spin while they wait for one another: beside other work, sums that NumPy
    # does in 0.1 s of processor time on one thread took 9 s, and a minute.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # JAX makes millions of small objects while it traces; to look them through so often is a sixth
    # of that time.
    gc.set_threshold(50_000, 20, 10)


def _describe_error(error: Exception) -> tuple[str, int]:
    """Return an error in one line and its exit code."""
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


def _usage() -> str:
    lines = "\n".join(
        f"  {name:{len('import-keras')}}  {what}" for name, (_, what) in COMMANDS.items()
    )
    return (
        "usage: softfin COMMAND [OPTION ...]\n\nMake a soft fin produce the force you ask for.\n\n"
        f"{lines}\n\nsoftfin COMMAND --help lists a command's options; --debug shows tracebacks;"
        f" softfin --version prints the version.\n{describe_cache()}"
    )


def _exit(message: str, code: int) -> None:
    # A terminal that was closed cannot be written to; the code still counts.
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(message) + "\n")
        sys.stderr.flush()
    raise SystemExit(code)
