"""The surrogate: two nets learnt from logs that stand in for the fin (paper Sec. III-B)."""

from softfin.surrogate.fit import FitConfig
from softfin.surrogate.keras import import_keras
from softfin.surrogate.store import load_surrogate, save_surrogate
from softfin.surrogate.surrogate import Surrogate

__all__ = ["FitConfig", "Surrogate", "import_keras", "load_surrogate", "save_surrogate"]
