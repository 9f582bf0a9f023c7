"""Controllers at run time with NumPy and safetensors alone: no JAX, no pydantic, nothing compiled."""

from softfin.control.native.controller import NativeController, TrainingRange, trimmed
from softfin.control.native.load import load_native
from softfin.control.native.trim import Trim, TrimSettings
from softfin.gaits.region import Box, Pair, Region

__all__ = [
    "Box",
    "NativeController",
    "Pair",
    "Region",
    "TrainingRange",
    "Trim",
    "TrimSettings",
    "load_native",
    "trimmed",
]
