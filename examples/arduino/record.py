"""Writes logs as a student's rig would: a hobby servo, an AS5600 encoder and two load cells on HX711 converters, read by an
Arduino about 80 times per second.

    python examples/arduino/record.py logs                            # six logs of 90 s
    python examples/arduino/record.py logs --logs 2 --seconds 30

The fin is the hand-sized one of `examples/fins/hand.yaml`. Angles are in degrees, 90 in the middle. Forces are in grams, and
the side load cell is mounted the wrong way round.
"""

import argparse
import csv
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np

import softfin

HAND = Path(__file__).parents[1] / "fins/hand.yaml"
SERVO_SPEED_RAD_S = 7.0
"""A hobby servo receives an angle only, and always moves at its own speed."""
REACH_RAD = 1.0
HOLD_S = (0.35, 1.2)
"""Shortest and longest time between two random angles."""
RATE_HZ = 80
JITTER_S = 0.0008
ENCODER_STEP_DEG = 360 / 4096
FORCE_LAG_S = 0.02
FORCE_NOISE_GF = 0.15
NEWTONS_PER_GF = 0.00980665
COLUMNS = ("millis", "servo_cmd_deg", "encoder_deg", "loadcell_thrust_gf", "loadcell_side_gf")


def random_angles(ticks: int, random: np.random.Generator) -> np.ndarray:
    """Return random commanded angles [rad] for each tick of 10 ms, each held for a random time."""
    angles = np.zeros(ticks, np.float32)
    start = 0
    while start < ticks:
        end = start + int(100 * random.uniform(*HOLD_S))
        angles[start:end] = random.uniform(-REACH_RAD, REACH_RAD)
        start = end
    return angles


def move(plant: Any, angles: np.ndarray, seed: int) -> softfin.Reading:
    """Move the fin through the commanded angles, and return a reading per tick."""

    def tick(state: Any, angle: Any) -> tuple[Any, Any]:
        command = softfin.Command(angle, np.float32(SERVO_SPEED_RAD_S))
        state, reading = plant.advance(state, command, 1)
        return state, jax.tree.map(lambda value: value[0], reading)

    _, readings = jax.lax.scan(tick, plant.init(jax.random.key(seed)), angles)
    return readings


def sample(readings: softfin.Reading, angles: np.ndarray, random: np.random.Generator) -> Any:
    """Return the rows that the Arduino would send."""
    time_s = np.asarray(readings.time)
    times = np.arange(time_s[0], time_s[-1], 1 / RATE_HZ)
    times += random.normal(0, JITTER_S, times.size)
    command = angles[np.clip(np.searchsorted(time_s, times), 0, angles.size - 1)]
    angle_deg = 90 + np.rad2deg(np.interp(times, time_s, readings.angle))
    forces = [
        np.interp(times - FORCE_LAG_S, time_s, force_n) / NEWTONS_PER_GF
        + random.normal(0, FORCE_NOISE_GF, times.size)
        for force_n in np.asarray(readings.force).T
    ]
    encoder_deg = np.round(angle_deg / ENCODER_STEP_DEG) * ENCODER_STEP_DEG
    return np.column_stack(
        [1000 * times, 90 + np.rad2deg(command), encoder_deg, forces[0], -forces[1]]
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--logs", type=int, default=6)
    parser.add_argument("--seconds", type=int, default=90)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    if any(arguments.out.glob("run*.csv")):
        sys.exit(f"{arguments.out}: contains runs; choose a different folder")
    plant = softfin.find_plant(str(HAND))
    moved = jax.jit(lambda angles, seed: move(plant, angles, seed))
    arguments.out.mkdir(parents=True, exist_ok=True)
    for log in range(arguments.logs):
        random = np.random.default_rng([arguments.seed, log])
        angles = random_angles(100 * arguments.seconds, random)
        rows = sample(moved(angles, 1000 * arguments.seed + log), angles, random)
        with (arguments.out / f"run{log + 1}.csv").open("w", newline="") as file:
            table = csv.writer(file)
            table.writerow(COLUMNS)
            for millis, *values in rows.tolist():
                table.writerow([round(millis), *(f"{value:.2f}" for value in values)])


if __name__ == "__main__":
    main()
