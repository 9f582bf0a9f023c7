"""``softfin collect``: a plant in, a dataset out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Armed, Configured
from softfin.cli.kinds import AnyPlant, Out, folder_of
from softfin.core.choices import Excitation
from softfin.core.errors import ConfigurationError
from softfin.storage.registry import is_live


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
        """Refuse options that do not go with the plant."""
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
        from softfin.rig.robot_setup import find_robot
        from softfin.stages.collect import collect
        from softfin.stages.live import collect_live
        from softfin.surrogate.active import ActiveCollectConfig

        kind = ActiveCollectConfig if self.excitation == "active" else CollectConfig
        config = self.configured(kind() if self.extend is None else kind(test_logs=0))
        if is_live(self.plant):
            robot = find_robot(self.plant)
            data = self.stage(collect_live, robot, self.out, config, self.confirm, resume=self.resume)
        else:
            chosen = {"surrogate": self.surrogate, "extend": self.extend}
            data = self.stage(collect, self.plant, self.out, config, **chosen)
        counts = {"logs": len(data.train), "test_logs": len(data.test), "rows": config.rows}
        more = "" if self.extend is None else f", and those of {self.extend}"
        self.tell(
            {"dataset": str(self.out), **counts, "data_hash": data.data_hash},
            f"{self.out}: {config.logs} + {config.test_logs} logs of {config.rows:,} rows{more}",
        )
