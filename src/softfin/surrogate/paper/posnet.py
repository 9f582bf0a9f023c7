"""PosNet: the last second of commands in, the shaft's angle one sample later out (paper Sec. III-B, Table I)."""

from softfin.surrogate.paper.network import Conv1D, Dense, Flatten, NetworkConfig

COMMANDS = ("command_angle_rad", "command_velocity_rad_s")

POSNET = NetworkConfig(
    channels=COMMANDS,
    outputs=("angle_rad",),
    layers=(
        Conv1D(filters=128, kernel=5),
        Conv1D(filters=64, kernel=3),
        Flatten(),
        Dense(units=128),
        Dense(units=64),
        Dense(units=1, activation="linear"),
    ),
)
"""113,601 parameters, as in Table I and as published."""
