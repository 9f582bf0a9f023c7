"""Seeds that every random number generator accepts."""

from softfin.core.choices import SEEDS
from softfin.core.errors import ConfigurationError


def check_seed(seed: int | None) -> None:
    """Raise ConfigurationError if a random number generator would not accept the seed."""
    if seed is not None and not 0 <= seed < SEEDS:
        raise ConfigurationError(f"--seed {seed}: must be an integer from 0 to {SEEDS - 1}")
