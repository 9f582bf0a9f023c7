"""Models of the fin, fitted to logs: the paper's networks (Sec. III-B) and streaming ensembles."""

from softfin.surrogate.paper.fit import FitConfig
from softfin.surrogate.paper.keras import read_keras_surrogate
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.store import AnySurrogate, load_surrogate, save_surrogate
from softfin.surrogate.streaming.fit import StreamingConfig
from softfin.surrogate.streaming.streaming import StreamingSurrogate

__all__ = [
    "AnySurrogate",
    "FitConfig",
    "StreamingConfig",
    "StreamingSurrogate",
    "Surrogate",
    "load_surrogate",
    "read_keras_surrogate",
    "save_surrogate",
]
