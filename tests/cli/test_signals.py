"""Signals after the one that stopped the fin, because people press Ctrl-C repeatedly."""

import subprocess
import sys
from pathlib import Path

import pytest

from softfin import cli
from tests.patience import HANG_S

ROOT = Path(__file__).parents[2]

PROGRAM = """
import builtins
import os
import signal
import sys

from softfin import cli
from softfin.rig.safety import Guard, SafetyConfig
from softfin.rig.session import Session
from tests.rig.machines import FreeFin, Hours

NUMBER = getattr(signal, sys.argv[1])
PLACE = sys.argv[2]


class Late:
    # Python has already removed its signal handlers at this point.
    def __del__(self, kill=os.kill, number=NUMBER, process=os.getpid()):
        kill(process, number)


def interrupted(call):
    def instead(*values):
        for _ in range(2):
            signal.raise_signal(NUMBER)
        return call(*values)

    return instead


def run(*, arm: bool = False) -> None:
    machine = FreeFin(Hours())
    try:
        with Session(machine, Guard(SafetyConfig(), machine.limits)) as session:
            session.stop_on_signals()
            session.activate()
            signal.raise_signal(signal.SIGINT)
            session.tick()
    finally:
        if PLACE == "results":
            interrupted(int)()


cli.import_function = lambda name: run
if PLACE == "message":
    cli._describe_error = interrupted(cli._describe_error)
if PLACE == "end":
    builtins.late = Late()
sys.argv[1:] = ["run", "--arm"]
cli.script()
"""


@pytest.mark.parametrize(
    ("name", "place"),
    [("SIGINT", "nowhere"), ("SIGTERM", "results"), ("SIGHUP", "message"), ("SIGTERM", "end")],
)
def test_signals_after_a_stop_change_neither_its_message_nor_its_exit_code(name, place):
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM, name, place],
        capture_output=True,
        text=True,
        cwd=ROOT,
        timeout=HANG_S,
    )
    message = "softfin run: stopped, motor disabled: stopped by Ctrl-C\n"
    assert (run.returncode, run.stderr) == (cli.FIN_STOPPED, message)
