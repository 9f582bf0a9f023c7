"""``softfin collect``: a plant in, a dataset out."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from softfin.cli.common import Configured, progress
from softfin.cli.kinds import AnyPlant, Out, folder_of
from softfin.cli.live import Armed
from softfin.core.choices import Excitation
from softfin.core.errors import ConfigurationError
from softfin.storage.registry import is_live

if TYPE_CHECKING:
    from softfin.data.collect import CollectConfig
    from softfin.storage.dataset import Dataset


@dataclass(frozen=True, kw_only=True)
class Arguments(Armed, Configured):
    """Record motions of a fin and its force as a dataset (paper Sec. III-A)."""

    out: Out
    """Folder of the dataset to write."""
    plant: AnyPlant = "tank"
    """The fin: tank, a tank's YAML, the folder of a surrogate, package.module:plant; or a real one: rig, ros2, or
    one of these with :FILE."""
    excitation: Excitation = "random"
    """random: as the paper's; active: the motions whose force the ensemble in --surrogate is least sure of."""
    surrogate: Annotated[Path, folder_of("surrogate")] | None = None
    """Folder of the ensemble that chooses, fitted to logs of this fin, of --excitation active."""
    extend: Annotated[Path, folder_of("dataset")] | None = None
    """Folder of a dataset of this fin whose logs are taken over: the new one holds both."""
    logs: int | None = None
    """Training logs to record (the paper's 100)."""
    test_logs: int | None = None
    """Test logs to record, under other conditions (the paper's 3; none with --extend)."""
    rows: int | None = None
    """Readings a log at 100 Hz (the paper's 20,000)."""
    seed: int | None = None
    """Seed of commands, noise and conditions (0)."""
    resume: bool = False
    """Go on after the logs that are finished (real fins only)."""

    def check(self) -> None:
        """Whether the options go with the plant."""
        super().check()
        if is_live(self.plant):
            if self.extend is not None or self.excitation == "active":
                option = "--extend" if self.extend is not None else "--excitation active"
                raise ConfigurationError(f"{option}: not on a real fin; record random motions there")
        elif self.arm or self.resume:
            option = "--arm" if self.arm else "--resume"
            raise ConfigurationError(f"{option}: {self.plant} is simulated; leave it out, or give --plant rig")

    def run(self) -> None:
        """Collect."""
        from softfin.data.collect import CollectConfig
        from softfin.surrogate.active import ActiveCollectConfig

        fewer = {} if self.extend is None else {"test_logs": 0}
        base = (ActiveCollectConfig if self.excitation == "active" else CollectConfig)(**fewer)
        config = self.configured(base, logs=self.logs, test_logs=self.test_logs, rows=self.rows, seed=self.seed)
        data = self._live(config) if is_live(self.plant) else self._simulated(config)
        counts = {"logs": len(data.train), "test_logs": len(data.test), "rows": config.rows}
        result = {"dataset": str(self.out), **counts, "data_hash": data.data_hash}
        of = f"{config.rows:,} rows" if self.extend is None else f"{config.rows:,} rows, and those of {self.extend}"
        self.tell(result, f"{self.out}: {config.logs} + {config.test_logs} logs of {of}")

    def _simulated(self, config: "CollectConfig") -> "Dataset":
        from softfin.stages.collect import collect

        with progress() as report:
            return collect(
                self.plant, Path(self.out), config, surrogate=self.surrogate, extend=self.extend,
                overwrite=self.overwrite, progress=report,
            )  # fmt: skip

    def _live(self, config: "CollectConfig") -> "Dataset":
        from softfin.rig.robot_setup import find_robot
        from softfin.stages.live import collect_live

        with progress() as report:
            return collect_live(
                find_robot(self.plant), Path(self.out), config, self.confirm,
                resume=self.resume, overwrite=self.overwrite, progress=report,
            )  # fmt: skip
