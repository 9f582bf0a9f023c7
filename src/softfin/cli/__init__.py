"""The command line: ``softfin COMMAND``.

The module of a command is imported only when the command runs.
"""

import contextlib
import difflib
import gc
import importlib
import importlib.metadata
import inspect
import logging
import os
import select
import signal
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from softfin.core.printable import printable
from softfin.core.program_cache import describe_cache, use_program_cache


class Command(NamedTuple):
    """One entry in the list of commands."""

    place: str
    """Function of the command, as ``module:name``."""
    summary: str
    """Description in the list of commands."""


GROUPS = {
    "Start": {
        "demo": Command(
            "softfin.stages.reproduce:demo", "run every stage on a simulated fin and write a report"
        ),
        "example": Command(
            "softfin.stages.example:write_example",
            "write a trained surrogate, controllers and a recording",
        ),
        "doctor": Command(
            "softfin.stages.doctor:doctor", "check this computer and the installation"
        ),
    },
    "Data": {
        "collect": Command(
            "softfin.stages.collect:collect", "record random fin motions and the resulting forces"
        ),
        "inspect": Command(
            "softfin.stages.logs:inspect_logs", "check logs before you fit a surrogate to them"
        ),
        "import-logs": Command(
            "softfin.stages.logs:import_logs",
            "convert CSV files, Parquet files or ROS 2 bags into a dataset",
        ),
        "bag recover": Command(
            "softfin.stages.logs:recover_recording", "recover the readings of a damaged recording"
        ),
    },
    "Model": {
        "fit": Command("softfin.stages.surrogates:fit", "fit a surrogate model of the fin to logs"),
        "calibrate": Command(
            "softfin.stages.surrogates:calibrate", "fit the virtual tank to logs or to a plant"
        ),
    },
    "Controllers": {
        "map": Command(
            "softfin.stages.controllers:map_forces", "find the mean forces that a fin can produce"
        ),
        "family": Command(
            "softfin.stages.controllers:family",
            "find how the fin of a controller may change, for feedback",
        ),
        "train": Command(
            "softfin.stages.controllers:train", "train force controllers inside a surrogate"
        ),
        "evaluate": Command(
            "softfin.stages.evaluation:evaluate",
            "evaluate a controller on a fin over reference forces",
        ),
        "benchmark": Command(
            "softfin.stages.benchmark:benchmark",
            "run the benchmark protocol on a controller or a policy",
        ),
        "explore": Command(
            "softfin.stages.explore:explore",
            "write an HTML page to try controllers or to move the fin by hand",
        ),
        "export": Command("softfin.stages.controllers:export", "export a controller to ONNX"),
    },
    "Rig": {
        "rig check": Command(
            "softfin.stages.rig:check", "check drive, sensor and settings; nothing moves"
        ),
        "rig zero": Command("softfin.stages.rig:zero", "zero the angle and the force"),
        "rig stop": Command("softfin.stages.rig:stop", "stop the motor and switch it off"),
        "rig emulate": Command("softfin.stages.rig:emulate", "emulate a rig without hardware"),
        "run": Command("softfin.stages.driving:run", "hold reference forces on the real fin"),
        "monitor": Command(
            "softfin.rig.monitor.web:monitor", "watch a recording in progress on a web page"
        ),
        "ros2": Command(
            "softfin.stages.driving:ros2",
            "hold reference forces from a ROS 2 topic on the real fin",
        ),
    },
    "Robots": {
        "robot check": Command(
            "softfin.stages.robot:check", "check rank, reach and stability of a multi-fin robot"
        ),
        "robot evaluate": Command(
            "softfin.stages.robot:evaluate", "evaluate the wrench errors of a robot node"
        ),
        "robot ros2": Command(
            "softfin.stages.robot:ros2", "run a ROS 2 node that distributes wrenches among fins"
        ),
    },
    "Paper": {
        "reproduce": Command(
            "softfin.stages.reproduce:reproduce",
            "run every stage of the paper and print its tables",
        ),
    },
}
"""The commands by topic."""

COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}

MIN_FILE_DESCRIPTOR = 3
"""Number of the first file that is not a standard stream."""

STOPPED = 1
"""Exit code after Ctrl-C, the same as for a failure at run time."""

FIN_STOPPED = 3
"""Exit code after a safety check or a person stopped the fin."""

PIPE_CLOSED = 128 + signal.SIGPIPE
"""Exit code if the reader of standard output ends first, as in ``softfin doctor | head -1``; a
shell reports the same for other programs."""


def script() -> None:
    """Run `main` as the installed command. After Ctrl-C or a stop of the fin, exit immediately: a
    compiled program may still be running, and another Ctrl-C would change the exit code."""
    _replace_closed_streams()
    use_program_cache()
    try:
        main()
        sys.stdout.flush()
    except OSError as error:
        # Commands turn their errors into exit codes, so this one is of standard output. Without
        # the following line, Python would try to write the rest when it exits.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        if isinstance(error, BrokenPipeError):
            raise SystemExit(PIPE_CLOSED) from None
        _exit(f"softfin: standard output: {error.strerror}", STOPPED)
    except SystemExit as stop:
        is_interrupted = isinstance(stop.__cause__, KeyboardInterrupt)
        if not is_interrupted and stop.code != FIN_STOPPED:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(STOPPED if is_interrupted else FIN_STOPPED)


def _replace_closed_streams() -> None:
    """Open the null device in place of standard streams that the shell has closed, e.g. with
    ``>&-``.

    Otherwise, the next file that a command opens would receive the printed output.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) < MIN_FILE_DESCRIPTOR:
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or os.fdopen(1, "w", encoding="utf-8")
    sys.stderr = sys.stderr or os.fdopen(2, "w", encoding="utf-8")


def _is_reader_gone() -> bool:
    """Return whether the program that reads standard output through a pipe has ended."""
    poll = select.poll()
    poll.register(sys.stdout, 0)
    return any(event & select.POLLERR for _, event in poll.poll(0))


def main(arguments: Sequence[str] | None = None) -> None:
    """Run one command. Exit codes: 0 success, 1 failure at run time, 2 unusable input, 3 fin
    stopped for safety."""
    words = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    for count in (2, 1):
        name = " ".join(words[:count])
        if name in COMMANDS:
            _run(name, words[count:])
            return
    first, *rest = words
    actions = {name: each for name, each in COMMANDS.items() if name.split()[0] == first}
    if first in ("-h", "--help"):
        sys.stdout.write(_usage() + "\n")
    elif first in ("-V", "--version"):
        sys.stdout.write(f"softfin {importlib.metadata.version('softfin')}\n")
    elif actions and rest in ([], ["-h"], ["--help"]):
        sys.stdout.write(f"Usage: softfin {first} ACTION [OPTIONS]\n\n{_list(actions)}\n")
    else:
        typed = " ".join(words[:2] if actions else words[:1])
        names = list(actions) or list(dict.fromkeys(name.split()[0] for name in COMMANDS))
        close = difflib.get_close_matches(typed, names, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        _exit(f"softfin: unknown command {typed!r}; use {', '.join(names)}{hint}", 2)


def import_function(name: str) -> Callable[..., object]:
    """Import the function that is a command."""
    module, _, function = COMMANDS[name].place.partition(":")
    imported: Callable[..., object] = getattr(importlib.import_module(module), function)
    return imported


def _run(name: str, words: list[str]) -> None:
    is_debugged = "--debug" in words
    hint = ""
    _configure_process()
    with contextlib.ExitStack() as until_exit:
        try:
            function = import_function(name)
            if "resume" in inspect.signature(function).parameters and _can_resume(name, words):
                hint = "; run it again with --resume to continue"
            _call(name, function, words, until_exit)
        except KeyboardInterrupt as interrupt:
            if is_debugged:
                raise
            sys.stderr.write(f"softfin {name}: stopped; no incomplete files were left{hint}\n")
            raise SystemExit(STOPPED) from interrupt
        except Exception as error:
            if is_debugged or (isinstance(error, BrokenPipeError) and _is_reader_gone()):
                raise
            message, code = _describe_error(error)
            _exit(f"softfin {name}: {message}", code)


def _can_resume(name: str, words: Sequence[str]) -> bool:
    """Return whether a stopped command can be resumed; simulated motions are recorded again."""
    from softfin.storage.registry import is_live

    return name != "collect" or any(is_live(word.removeprefix("--plant=")) for word in words)


def _call(
    name: str,
    function: Callable[..., object],
    words: list[str],
    until_exit: contextlib.ExitStack,
) -> None:
    """Parse the words of a command, call its function and print the result."""
    # Imported here to keep --version and --help fast.
    from softfin.cli import application
    from softfin.cli.output import print_result, progress

    if "-h" in words or "--help" in words:
        sys.stdout.write(application.format_help(function, f"softfin {name}") + "\n")
        return
    typed = [word for word in words if word not in ("--json", "--debug")]
    call = application.parse(function, typed, f"softfin {name}")
    if call.keywords.get("arm"):
        # Imported here, because most commands do not need the rig.
        from softfin.rig.stop import undisturbed_after_stop

        until_exit.enter_context(undisturbed_after_stop())
    if "progress" in inspect.signature(function).parameters:
        with progress() as report:
            result = call(progress=report)
    else:
        result = call()
    print_result(result, as_json="--json" in words)


def _configure_process() -> None:
    """Set the environment variables that NumPy, JAX and XLA read on import."""
    # Compilation messages from XLA would hide the output of the command.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    # OpenBLAS threads busy-wait for each other. On a loaded machine, sums that cost 0.1 s of CPU
    # time on one thread took from 9 s to a minute.
    if "OMP_NUM_THREADS" not in os.environ:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # JAX creates millions of small objects while it traces; collecting garbage at the default rate
    # takes a sixth of that time.
    gc.set_threshold(50_000, 20, 10)
    # Matplotlib warns if it cannot write to the user's home folder.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)


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
    return f"{text} (unexpected; add --debug for a traceback)", STOPPED


def _list(commands: Mapping[str, Command]) -> str:
    return "\n".join(f"  {name:14}  {command.summary}" for name, command in commands.items())


def _usage() -> str:
    groups = "\n\n".join(f"{title}:\n{_list(commands)}" for title, commands in GROUPS.items())
    return (
        "Usage: softfin COMMAND [OPTIONS]\n\nMake a soft fin produce the force you ask for.\n\n"
        f"{groups}\n\nRun softfin COMMAND --help for the options of a command, and softfin "
        f"--version for the version. Add --debug for tracebacks.\n{describe_cache()}"
    )


def _exit(message: str, code: int) -> None:
    # A closed terminal cannot be written to, but the exit code still counts.
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(message) + "\n")
        sys.stderr.flush()
    raise SystemExit(code)
