"""A surrogate small enough for tests, with random weights."""

import jax
import numpy as np

from softfin.core.quantities import Command, Log, Reading
from softfin.surrogate import Surrogate
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, ChannelScaling, Scaling
from softfin.surrogate.paper.network import (
    LSTM,
    Conv1D,
    Dense,
    Dropout,
    Flatten,
    MeanPool,
    Network,
    NetworkConfig,
)

WINDOW = 12

POSNET = NetworkConfig(
    channels=COMMAND_COLUMNS,
    outputs=(ANGLE,),
    window=WINDOW,
    layers=(
        Conv1D(filters=8, kernel=5),
        Conv1D(filters=4, kernel=3),
        Flatten(),
        Dense(units=1, activation="linear"),
    ),
)
FORCENET = NetworkConfig(
    channels=(ANGLE, *COMMAND_COLUMNS),
    outputs=FORCES,
    window=WINDOW,
    layers=(
        LSTM(units=24, sequence=True),
        MeanPool(),
        Dense(units=24, activation="tanh"),
        Dropout(rate=0.1),
        Dense(units=2, activation="linear"),
    ),
)


def scaling() -> Scaling:
    ranges = {
        COMMAND_COLUMNS[0]: (-1.5, 1.5),
        COMMAND_COLUMNS[1]: (1.0, 3.0),
        ANGLE: (-1.6, 1.6),
        FORCES[0]: (-9.0, 12.0),
        FORCES[1]: (-11.0, 10.0),
    }
    return Scaling(
        channels={
            name: ChannelScaling(
                scale=1 / (high - low), offset=-low / (high - low), data_min=low, data_max=high
            )
            for name, (low, high) in ranges.items()
        }
    )


def surrogate(seed: int = 0) -> Surrogate:
    first, second = jax.random.split(jax.random.key(seed))
    return Surrogate(Network.create(POSNET, first), Network.create(FORCENET, second), scaling())


def log(rows: int, seed: int = 0) -> Log:
    """Commands held for a while, an angle that follows them, a force that follows both."""
    random = np.random.default_rng(seed)
    target = np.repeat(random.uniform(-1.5, 1.5, rows // 20 + 1), 20)[:rows]
    speed = np.repeat(random.uniform(1.0, 3.0, rows // 20 + 1), 20)[:rows]
    angle = np.convolve(target, np.ones(10) / 10)[:rows]
    motion = np.gradient(angle)
    force = np.stack([50 * motion**2, 5 * motion + angle], axis=1) + random.normal(
        0, 0.01, (rows, 2)
    )
    series = [
        x.astype(np.float32)
        for x in (target, speed, np.arange(rows) / 100, angle, motion * 100, force)
    ]
    return Log(Command(*series[:2]), Reading(*series[2:]))
