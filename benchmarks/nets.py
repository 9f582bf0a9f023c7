"""A surrogate with the published layout (two LSTM layers, 144,258 + 113,601 parameters) and random
weights.

Speed does not depend on the weights' values, and the published files are not part of softfin.
"""

import jax

from softfin.surrogate import Surrogate
from softfin.surrogate.channels import ANGLE, COMMAND_COLUMNS, FORCES, ChannelScaling, Scaling
from softfin.surrogate.paper.network import LSTM, POSNET, Dense, Dropout, Network, NetworkConfig

PUBLISHED_FORCENET = NetworkConfig(
    channels=(ANGLE, *COMMAND_COLUMNS),
    outputs=FORCES,
    layers=(
        LSTM(units=128, sequence=True),
        LSTM(units=32),
        Dense(units=64),
        Dense(units=64),
        Dropout(rate=0.2),
        Dense(units=2, activation="linear"),
    ),
)

RANGES = {
    ANGLE: 1.6,
    COMMAND_COLUMNS[0]: 1.6,
    COMMAND_COLUMNS[1]: 1.6,
    FORCES[0]: 18.0,
    FORCES[1]: 18.0,
}


def paper_layout(forcenet: NetworkConfig) -> Surrogate:
    """PosNet and a ForceNet: Table I's, as `softfin fit --model paper` makes it, or the published
    one."""
    scaling = Scaling(
        channels={
            name: ChannelScaling(scale=0.5 / reach, offset=0.5, data_min=-reach, data_max=reach)
            for name, reach in RANGES.items()
        }
    )
    first, second = jax.random.split(jax.random.key(0))
    return Surrogate(Network.create(POSNET, first), Network.create(forcenet, second), scaling)


def published_layout() -> Surrogate:
    return paper_layout(PUBLISHED_FORCENET)
