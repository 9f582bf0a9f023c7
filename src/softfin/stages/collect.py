"""Records the motion of a plant as a dataset (paper Sec. III-A)."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.core.configuration import configure
from softfin.core.errors import ConfigurationError
from softfin.core.option_types import DIR, HIDDEN, PLANT, Config, PathLike, PlantLike
from softfin.core.progress import Progress, silent
from softfin.core.result import Result
from softfin.core.seeds import check_seed
from softfin.storage import artifact as artifacts
from softfin.storage.output_lock import lock_output
from softfin.storage.registry import check_plant, is_live

if TYPE_CHECKING:
    from softfin.data.collect import CollectConfig
    from softfin.storage.dataset import Dataset


@lock_output
def collect(
    *,
    plant: Annotated[PlantLike, PLANT] = "tank",
    out: Annotated[PathLike, DIR],
    logs: int | None = None,
    test_logs: int | None = None,
    rows: int | None = None,
    seed: int | None = None,
    config: Config = None,
    resume: bool = False,
    arm: bool = False,
    yes: bool = False,
    overwrite: bool = False,
    progress: Annotated[Progress, HIDDEN] = silent,
) -> Result:
    """Record random fin motions and the resulting forces as a dataset (paper Sec. III-A).

    For the virtual tank, each test log is recorded in a perturbed tank. For other plants, test logs
    differ only in their seed.

    Args:
        plant: tank, a YAML file, a surrogate folder, package.module:plant, rig[:FILE] or
            ros2[:FILE].
        out: Dataset folder to write.
        logs: Number of training logs (default: 100, as in the paper).
        test_logs: Number of test logs, each in a perturbed tank (default: 3, as in the paper).
        rows: Readings per log, at 100 Hz (default: 20000, as in the paper).
        seed: Seed for commands, noise and conditions (default: 0).
        config: `CollectConfig`; its fields are options too, such as --excitation.hold-min-s 0.2.
        resume: Resume after the last complete log (real fins only).
        arm: Allow the real fin to move, after you confirm on the terminal.
        yes: With --arm, skip the confirmation. For scripts; make sure that no one can touch the
            fin.
        overwrite: Replace existing output, and discard an unfinished run.
        progress: Function that is called with the progress.

    Returns:
        Folder, number of logs and rows, and hash of the dataset.

    Example:
        >>> softfin.collect(plant="tank", out="dataset", logs=10, rows=6000)
    """
    out = Path(out)
    check_seed(seed)
    artifacts.check_vacant(out, overwrite or resume, kind="dataset")
    is_real = isinstance(plant, str) and is_live(plant)
    for option, is_given in (("--arm", arm), ("--resume", resume)):
        if is_given and not is_real:
            raise ConfigurationError(
                f"{option}: {plant} is simulated; omit {option}, or use --plant rig"
            )
    if not is_real:
        check_plant(plant)
    from softfin.data.collect import CollectConfig

    settings = configure(
        CollectConfig(), config, logs=logs, test_logs=test_logs, rows=rows, seed=seed
    )
    if isinstance(plant, str) and is_real:
        from softfin.rig.arming import Arming, KeyboardStop, say
        from softfin.stages.live import collect_live
        from softfin.stages.machines import find_robot

        keys = KeyboardStop(Arming(arm, yes))
        data = collect_live(
            find_robot(plant),
            out,
            settings,
            keys.confirm,
            resume=resume,
            stop=keys.stop,
            warn=say,
            overwrite=overwrite,
            progress=progress,
        )
    else:
        data = _collect_simulated(plant, out, settings, overwrite, progress)
    return Result(
        {
            "dataset": str(out),
            "logs": len(data.train),
            "test_logs": len(data.test),
            "rows": settings.rows,
            "data_hash": data.data_hash,
        },
        f"{out}: {settings.logs} + {settings.test_logs} logs of {settings.rows:,} rows",
    )


def _collect_simulated(
    plant: PlantLike, out: Path, config: "CollectConfig", overwrite: bool, progress: Progress
) -> "Dataset":
    from softfin.core.plant_identity import identity
    from softfin.core.randomness import named_key
    from softfin.data.collect import collect_logs
    from softfin.storage.registry import find_plant
    from softfin.tank import Tank, sample_tank

    simulated = find_plant(plant)
    test_plants = [simulated] * config.test_logs
    if isinstance(simulated, Tank):
        names = [f"collect/conditions/{index}" for index in range(config.test_logs)]
        test_plants = [sample_tank(simulated, named_key(config.seed, name)) for name in names]
    metadata = {
        "plant": str(plant),
        "plant_identity": identity(simulated),
        "commands": {"excitation": "random"},
    }
    return collect_logs(simulated, config, out, test_plants, progress, metadata, overwrite)
