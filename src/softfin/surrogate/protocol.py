"""Interfaces of surrogates and of surrogate architectures.

`softfin.testing.check_surrogate` checks a surrogate. CONTRIBUTING.md describes how to add an
architecture.
"""

from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from pydantic import Field

from softfin.core.configuration import Configuration
from softfin.core.json_object import JsonObject
from softfin.core.plant import Plant, State
from softfin.core.quantities import Log
from softfin.surrogate.channels import NetPrediction, Scaling

COVERAGE = 0.9
"""Fraction of mean forces that should be inside the intervals of an ensemble."""


@runtime_checkable
class SurrogatePlant(Plant, Protocol):
    """A plant fitted to logs.

    Its state is a NamedTuple whose first field, `tick`, counts the samples since the start; no
    other field depends on the time. A surrogate that estimates its own error is also an
    `EnsemblePlant`.
    """

    @property
    def model(self) -> str:
        """Name of the architecture, accepted by `softfin.surrogate.registry.find_architecture`."""

    @property
    def memory(self) -> int:
        """Number of rows of a log that `warm` needs."""

    @property
    def scaling(self) -> Scaling | None:
        """Scaling of the channels for the scaled scores in Table I; None to divide these scores by
        the measured ranges instead."""

    def warm(self, history: Log) -> State:
        """Return the state after the last `memory` rows of a history.

        The command of the last row has not taken effect yet and is the first one passed to
        `advance`. Raises LogError if the history is too short.
        """

    def predictions(self, logs: Sequence[Log]) -> dict[str, NetPrediction]:
        """Predict the last rows of each log with each network; returns the rows of Table I, by
        network name."""

    def parameters(self) -> int:
        """Return the number of trainable parameters."""

    def to_files(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the entries of ``surrogate.json`` and the arrays by name; `Architecture.load`
        rebuilds the surrogate from them."""


@runtime_checkable
class ExplorableSurrogate(SurrogatePlant, Protocol):
    """A surrogate that the explorer page can simulate, because the script ``surrogate.js`` computes
    the same predictions."""

    def explorer_data(self) -> tuple[JsonObject, dict[str, np.ndarray]]:
        """Return the entries and arrays that the script reads."""


class SurrogateConfig(Configuration):
    """Configuration for fitting a surrogate; its class selects the architecture."""

    model: ClassVar[str]
    """Name of the architecture, as in `SurrogatePlant.model`."""

    held_out: float = Field(default=0.1, gt=0, lt=1)
    """Fraction of the training logs (at least one log, or the end of a single log) held out to
    choose the weights and to calibrate intervals. Without test logs, the surrogate is scored on the
    held-out logs."""


class Architecture(NamedTuple):
    """A surrogate architecture: softfin's own, or ``package.module:ARCHITECTURE``."""

    config: type[SurrogateConfig]
    """Configuration for the fit, with a default for each field."""
    fit: Callable[..., SurrogatePlant]
    """Function ``(logs, config, seed, run_directory, progress)`` that fits a surrogate to the
    training logs. It resumes from the checkpoint in `run_directory` if there is one."""
    load: Callable[[JsonObject, dict[str, np.ndarray], str], SurrogatePlant]
    """Function ``(description, weights, source)`` that builds a surrogate from the content of
    ``surrogate.json`` and the arrays. `source` is the file name for error messages; a
    ConfigurationError, KeyError, TypeError or ValueError is converted to an ArtifactError."""
