"""Streaming ensembles as a surrogate architecture."""

from softfin.surrogate.protocol import Architecture
from softfin.surrogate.streaming.fit import StreamingConfig, fit_streaming
from softfin.surrogate.streaming.streaming import StreamingSurrogate

STREAMING_ARCHITECTURE = Architecture(
    config=StreamingConfig, fit=fit_streaming, load=StreamingSurrogate.from_files
)
