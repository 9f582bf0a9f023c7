"""The paper's networks as an architecture of surrogates."""

from softfin.surrogate.paper.fit import FitConfig, fit_paper
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.protocol import Architecture, TableOneRow

PAPER_ARCHITECTURE = Architecture(
    config=FitConfig,
    fit=fit_paper,
    load=Surrogate.from_files,
    table_one={
        "posnet": TableOneRow("PosNet, commands to angle", "rad", "posnet"),
        "forcenet_measured": TableOneRow("ForceNet, given the measured angle", "N", "forcenet"),
        "forcenet_free_running": TableOneRow("ForceNet, free-running behind PosNet", "N"),
    },
)
