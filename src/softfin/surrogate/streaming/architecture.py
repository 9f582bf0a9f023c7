"""Streaming ensembles as an architecture of surrogates."""

from softfin.surrogate.protocol import Architecture, TableOneRow
from softfin.surrogate.streaming.fit import StreamingConfig, fit_streaming
from softfin.surrogate.streaming.streaming import StreamingSurrogate

STREAMING_ARCHITECTURE = Architecture(
    config=StreamingConfig,
    fit=fit_streaming,
    load=StreamingSurrogate.from_files,
    table_one={
        "drive": TableOneRow("Drive networks, commands to angle", "rad", "posnet"),
        "force_measured": TableOneRow("Force networks, given the measured motion", "N", "forcenet"),
        "force_free_running": TableOneRow(
            "Force networks, free-running behind the drive networks", "N"
        ),
    },
)
