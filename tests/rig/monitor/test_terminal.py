import io

import numpy as np
import pytest
from rich.console import Console

from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.terminal import BLOCKS, TRACE_COLUMNS, render, sparkline, watch
from tests.rig.monitor.bags import START_NS, Recording


def console(terminal=True, width=80):
    return Console(
        file=io.StringIO(), width=width, height=24, force_terminal=terminal, color_system=None
    )


@pytest.fixture
def followed(tmp_path):
    bag = tmp_path / ("a long name " * 9 + ".mcap")
    recording = Recording()
    for k in range(12):
        recording.chunk(100, reference=(1.25, -0.75), event=f"event {k} [red]\x1b[2J" + "x" * 100)
    bag.write_bytes(recording.skip(7).chunk(1).bytes)
    made = Follower(bag, wall=lambda: START_NS * 1e-9 + 12.3)
    made.poll()
    return made


def test_the_screen_fits_80_by_24_and_says_what_matters(followed):
    out = console()
    out.print(render(followed.summary(), followed.traces))
    text = out.file.getvalue()
    lines = text.splitlines()
    assert len(lines) <= 23
    assert max(map(len, lines)) <= 80
    assert "\x1b" not in text
    for what in (
        "recording, 12.1 s",
        "angle [rad]",
        "velocity [rad/s]",
        "force x [N]",
        "1.25",
        "-0.75",
        "torque [N m]",
        "current [A]",
        "gaps: joint 1 (7 rows), force 1 (7 rows)",
        "event 11 [red]",
    ):
        assert what in text
    assert any(letter in text for letter in BLOCKS)


def test_nothing_recorded_yet_is_a_screen_too(tmp_path):
    empty = Follower(tmp_path)
    empty.poll()
    out = console()
    out.print(render(empty.summary(), empty.traces))
    assert "no rows yet" in out.file.getvalue()


def test_a_trace_is_drawn_between_its_least_and_its_most():
    times = np.arange(0.0, 20.0, 0.01)
    least, drawn, most = sparkline(times, times.copy())
    assert (least, most) == ("0.00", "19.99")
    assert drawn == "".join(sorted(drawn))
    assert (drawn[0], drawn[-1], len(drawn)) == (BLOCKS[0], BLOCKS[-1], TRACE_COLUMNS)
    assert sparkline(times[:0], times[:0]) == ("-", " " * TRACE_COLUMNS, "-")
    assert sparkline(times[:2], np.array([np.nan, 1e300]))[0] == "-"


@pytest.mark.parametrize("terminal", [False, True])
def test_watching_ends_with_the_recording(tmp_path, terminal):
    bag = tmp_path / "run.mcap"
    recording = Recording().chunk(250, event="armed")
    bag.write_bytes(recording.bytes)
    out = console(terminal, 200)
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        if len(slept) == 3:
            bag.write_bytes(recording.finish().bytes)

    watch(Follower(bag), out, sleep=sleep)
    assert len(slept) == 3
    text = out.file.getvalue()
    assert "recording complete" in text
    assert text.removesuffix("\x1b[?25h").endswith("armed\n")
    assert text.count("armed") == 1 or terminal


def test_damage_ends_the_watching_in_a_line(tmp_path):
    bag = tmp_path / "run.mcap"
    bag.write_bytes(Recording().chunk(5).bytes + b"\x55" * 50)
    out = console(False, 300)
    watch(Follower(bag), out, sleep=lambda _: pytest.fail("waited"))
    assert "softfin bag recover" in out.file.getvalue()
