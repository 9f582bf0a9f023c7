"""The way of a student from an Arduino to a force: the page's commands, one after the other, and
the sketch that plays the gaits."""

import json
import re
import runpy
import shutil
import subprocess
import sys

import numpy as np
import pytest
import yaml

import softfin
from softfin.cli import main
from softfin.stages.example import EXAMPLE
from tests import staged
from tests.documents import ROOT, commands, softfin_words

PAGE = [
    shown
    for shown in commands()
    if shown.document == "docs/tutorials/5-arduino.md" and not shown.in_sentence
]
SMALLER = {
    "record.py": "--seconds 12",
    "fit": "--config streaming.yaml --force-updates 200",
    "map": "--config map.yaml --box null --spacing-n null --nodes 4",
    "evaluate": "--seconds 4 --repeats 1 --reference=0.05,0",
    "gait_table.py": "--forces 5",
}
"""Options that are added to a command, by its name."""
ARDUINO_H = """
#pragma once
#include <cstdio>
#include <cstdlib>
#include <string>
#define PROGMEM
#define pgm_read_word(address) (*(address))
unsigned long millis();
inline long map(long x, long a, long b, long c, long d) { return (x - a) * (d - c) / (b - a) + c; }
struct String : std::string {
  using std::string::string;
  long toInt() const { return atol(c_str()); }
};
struct Port {
  String line;
  void begin(long) {}
  void setTimeout(long) {}
  bool available() { return !line.empty(); }
  String readStringUntil(char) { String read = line; line.clear(); return read; }
} Serial;
"""
SERVO_H = """
#pragma once
#include "Arduino.h"
struct Servo {
  bool on = false;
  void attach(int) { on = true; }
  void detach() { on = false; printf("%lu off\\n", millis()); }
  bool attached() { return on; }
  void writeMicroseconds(int us) { printf("%lu %d\\n", millis(), us); }
};
"""
DAY = """
#include "Arduino.h"
unsigned long now_ms = 0;
unsigned long millis() { return now_ms; }
#include "play_gait.ino"
int main() {
  setup();
  for (; now_ms < 10000; now_ms++) {
    if (now_ms == 1000) Serial.line = "2";
    if (now_ms == 5000) Serial.line = "3";
    if (now_ms == 7000) Serial.line = "s";
    loop();
  }
}
"""
"""Plays row 2 for 4 s and row 3 for 2 s, and stops."""


def run_script(monkeypatch, path, *words):
    """Run a script of this folder as Python does."""
    monkeypatch.setattr(sys, "argv", [str(path), *map(str, words)])
    runpy.run_path(str(path), run_name="__main__")


def make_coarse_fin(folder):
    """Write the fin of the page so that its programs compile in less time."""
    fin = yaml.safe_load((ROOT / "examples/fins/hand.yaml").read_text())
    coarse = fin | staged.COARSE | {"fin": fin["fin"] | staged.COARSE["fin"]}
    folder.mkdir()
    (folder / "hand.yaml").write_text(yaml.safe_dump(coarse))


def read_table(path):
    """Read the numbers of gaits.h: constants by name, angles, and target forces."""
    text = path.read_text()
    constants = {name: int(value) for name, value in re.findall(r"const int (\w+) = (\d+);", text)}
    rows = re.findall(r"^  \{(.*)\},  // \d+: (\S+), (\S+) N$", text, re.MULTILINE)
    angles = np.array([list(map(int, row[0].split(","))) for row in rows])
    forces = np.array([list(map(float, row[1:])) for row in rows])
    millis = re.search(r"MILLIS\[ACTIONS\] = \{(.*)\}", text)[1]
    return constants, list(map(int, millis.split(","))), angles, forces


@pytest.mark.slow
def test_the_commands_of_the_page_run_one_after_the_other(tmp_path, monkeypatch, capsys):
    shutil.copytree(ROOT / "examples/arduino", tmp_path / "examples/arduino")
    make_coarse_fin(tmp_path / "examples/fins")
    for name, values in staged.CONFIGURATIONS.items():
        (tmp_path / name).write_text(yaml.safe_dump(values))
    monkeypatch.chdir(tmp_path)
    printed = {}
    for shown in PAGE:
        words = softfin_words(shown) or shown.words[1:]
        name = words[0].rpartition("/")[2]
        words = [*words, *SMALLER.get(name, "").split()]
        if name.endswith(".py"):
            run_script(monkeypatch, *words)
        else:
            main([*words, "--debug"])
        printed.setdefault(name, []).append(capsys.readouterr().out)
    assert set(SMALLER) <= set(printed)
    # Each advice is the next command's option.
    first, second, third = printed["inspect"]
    assert "--angle-zero=90" in first
    assert "--force=x,-y" in second
    assert "0 errors" in third
    evaluation = json.loads((tmp_path / "evaluation/evaluation.json").read_text())
    assert evaluation["mean"]["x"]["error_n"] < 0.15
    assert read_table(tmp_path / "examples/arduino/play_gait/gaits.h")[2].size


def test_the_table_has_the_commands_of_the_gaits(tmp_path, monkeypatch):
    script = ROOT / "examples/arduino/gait_table.py"
    run_script(monkeypatch, script, EXAMPLE / "gaits", tmp_path / "gaits.h", "--forces", "5")
    constants, millis, angles, forces = read_table(tmp_path / "gaits.h")
    controller = softfin.load_controller(EXAMPLE / "gaits")
    assert angles.shape == (constants["ROWS"], constants["ACTIONS"])
    assert sum(millis) == 10 * controller.clock.window_ticks
    assert len(angles) > 10
    assert controller.reachable.contains(forces, 0.01).all()
    limits = controller.limits
    for row, force in zip(angles, forces, strict=True):
        actions = np.asarray(controller.step.table.gait(force))[:, 0]
        angle = limits.angle_min + (actions + 1) / 2 * (limits.angle_max - limits.angle_min)
        np.testing.assert_allclose(row / 10 - 90, np.rad2deg(angle), atol=0.5)


def test_a_table_is_refused_where_the_servo_cannot_turn(tmp_path, monkeypatch):
    script = ROOT / "examples/arduino/gait_table.py"
    with pytest.raises(SystemExit, match="--centre"):
        run_script(monkeypatch, script, EXAMPLE / "gaits", tmp_path / "gaits.h", "--centre", "10")
    with pytest.raises(SystemExit, match="softfin map"):
        run_script(monkeypatch, script, EXAMPLE / "single", tmp_path / "gaits.h")
    assert not (tmp_path / "gaits.h").exists()


@pytest.mark.skipif(shutil.which("g++") is None, reason="g++ is not installed")
def test_the_sketch_plays_the_rows_of_its_table_and_stops(tmp_path, monkeypatch):
    folder = ROOT / "examples/arduino"
    run_script(monkeypatch, folder / "gait_table.py", EXAMPLE / "gaits", tmp_path / "gaits.h")
    shutil.copy(folder / "play_gait/play_gait.ino", tmp_path)
    for name, text in (("Arduino.h", ARDUINO_H), ("Servo.h", SERVO_H), ("day.cpp", DAY)):
        (tmp_path / name).write_text(text)
    program = tmp_path / "day"
    compiler = ["g++", "-std=c++11", "-Wall", "-Wextra", "-Werror", "-I", tmp_path]
    subprocess.run([*compiler, tmp_path / "day.cpp", "-o", program], check=True)
    lines = subprocess.run([program], capture_output=True, text=True, check=True).stdout.split("\n")
    _, millis, angles, _ = read_table(tmp_path / "gaits.h")
    starts = 1000 + np.cumsum([0, *np.resize(millis, 50)])
    starts = starts[starts < 7000]
    row = np.where(starts < 5000, 1, 2)
    decidegrees = angles[row, np.arange(len(starts)) % len(millis)]
    pulses = 544 + decidegrees * (2400 - 544) // 1800
    played = [f"{start} {pulse}" for start, pulse in zip(starts, pulses, strict=True)]
    assert lines == [*played, "7000 1472", "8000 off", ""]
