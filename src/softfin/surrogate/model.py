"""What every kind of surrogate offers beyond a Plant, to be fitted, stored, scored and compared like the others."""

from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, Protocol

import numpy as np
from jaxtyping import Float

from softfin.core.plant import Plant, State
from softfin.core.quantities import Log
from softfin.surrogate.channels import Scaling

SKIPPED = 100
"""Rows at the beginning of a log that Table I does not score: the first window of PosNet and ForceNet."""


class NetPrediction(NamedTuple):
    """What a net predicts of the last rows of a log: a row of Table I."""

    channels: tuple[str, ...]
    series: Float[np.ndarray, "predicted channels"]
    """Predicted values [rad or N]."""
    window: int | None
    """Samples of the past that the net sees; None of one with a state."""
    parameters: int
    """Trainable numbers of the net."""


class SurrogateModel(Plant, Protocol):
    """A surrogate of any kind."""

    model: ClassVar[str]
    """Name of the kind, as in ``surrogate.json``."""

    @property
    def memory(self) -> int:
        """Rows of a log that `warm` needs, at least 1."""
        ...

    @property
    def scaling(self) -> Scaling | None:
        """Scaling of the channels, in which the scaled scores of Table I are; None for the range of the test logs."""
        ...

    def warm(self, history: Log) -> State:
        """The state after a recording of at least `memory` rows: the next tick predicts row ``len(history)``."""
        ...

    def predictions(self, logs: Sequence[Log]) -> list[dict[str, NetPrediction]]:
        """Predictions of every log by the name of the net, for Table I."""
        ...

    def flops_per_tick(self) -> int:
        """Floating-point operations of the matrix products for one sample of one fin."""
        ...

    def parameters(self) -> int:
        """Trainable numbers."""
        ...

    def to_files(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """Entries of ``surrogate.json``, and the weights by name."""
        ...
