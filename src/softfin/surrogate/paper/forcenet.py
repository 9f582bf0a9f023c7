"""ForceNet: the last second of motion and commands in, the force one sample later out (paper Sec. III-B, Table I)."""

from softfin.surrogate.paper.network import LSTM, Dense, Dropout, MeanPool, NetworkConfig
from softfin.surrogate.paper.posnet import COMMANDS

FORCES = ("force_x_n", "force_y_n")

FORCENET = NetworkConfig(
    channels=("angle_rad", *COMMANDS),
    outputs=FORCES,
    layers=(
        LSTM(units=128, sequence=True),
        MeanPool(),
        Dense(units=64),
        Dense(units=64),
        Dropout(rate=0.4),
        Dense(units=2, activation="linear"),
    ),
)
"""129,794 parameters, as in Table I; the published weights have a second LSTM layer instead of the mean."""
