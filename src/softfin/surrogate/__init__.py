"""Models of the fin, fitted to logs: the paper's networks (Sec. III-B) and streaming ensembles.

``__init__.pyi`` lists the names. Each is imported on first use, so `softfin.surrogate.registry`
does not need JAX.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
