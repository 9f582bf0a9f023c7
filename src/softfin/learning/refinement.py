"""A second run over a finer grid: a trained one's worst cells are split, and the parts go on from its policies."""

from softfin.core.errors import ConfigurationError
from softfin.core.plant import Plant
from softfin.learning.refine import cell_errors, inherited, refine
from softfin.learning.train import Progress, TrainConfig, Trained, train
from softfin.storage.run_directory import Workspace


def check_refinable(config: TrainConfig, more: int) -> None:
    """Raise ConfigurationError unless `more` cells can be made of the run's."""
    if more < 0:
        raise ConfigurationError(f"--refine {more}: give the number of cells to add, 0 or more")
    if more and (config.controller != "grid" or config.algorithm != "gradient"):
        raise ConfigurationError(
            f"--refine {more}: only a grid that is trained by gradients is refined, not {config.controller} by "
            f"{config.algorithm}; leave it out, or give --controller grid --algorithm gradient"
        )
    if more > 3 * len(config.cells):
        raise ConfigurationError(
            f"--refine {more}: {len(config.cells)} cells are split once, into four each, so 1 .. "
            f"{3 * len(config.cells)} can be added; give fewer, or more --cells"
        )


def refined(
    plant: Plant, trained: Trained, more: int, workspace: Workspace, progress: Progress | None
) -> tuple[Trained, tuple[int, ...]]:
    """The same budget a policy once more, in this process; no cell ends worse than it was. And each cell's parent."""
    finer = refine(trained.config.cells, cell_errors(trained.score.error), more)
    ended = train(
        plant,
        trained.config.model_copy(update={"cells": finer.cells}),
        trained.seeds,
        workspace,
        progress,
        known=trained.known,
        start=inherited(trained.policies, finer.parents),
    )
    return ended, finer.parents
