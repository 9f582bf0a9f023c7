"""The paper's networks as a surrogate architecture."""

from softfin.surrogate.paper.fit import FitConfig, fit_paper
from softfin.surrogate.paper.surrogate import Surrogate
from softfin.surrogate.protocol import Architecture

PAPER_ARCHITECTURE = Architecture(config=FitConfig, fit=fit_paper, load=Surrogate.from_files)
