"""Controllers at run time with NumPy and safetensors alone: no JAX, no pydantic, nothing compiled."""

from softfin.deployment.native.controller import NativeController, TrainingRange, trimmed
from softfin.deployment.native.load import load_native
from softfin.deployment.native.region import Box, Pair, Region
from softfin.deployment.native.trim import Trim, TrimSettings

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
