"""``softfin import-keras``: published nets in, a surrogate out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Common
from softfin.cli.kinds import Out
from softfin.cli.options import Option
from softfin.core.errors import ArtifactError
from softfin.storage import paths


def _readable(metavar: str, positional: bool = False) -> Option:
    return Option(metavar, positional, check=lambda path, _: paths.check_readable(path, ArtifactError))


@dataclass(frozen=True, kw_only=True)
class Arguments(Common):
    """Turn two Keras 2 nets and their scalers into a surrogate; needs no TensorFlow and reads no pickle."""

    scalers: Annotated[Path, _readable("FILE")]
    """JSON of {channel: {scale, offset, data_min, data_max}}."""
    posnet: Annotated[Path, _readable("POSNET", positional=True)]
    """PosNet's .keras file."""
    forcenet: Annotated[Path, _readable("FORCENET", positional=True)]
    """ForceNet's .keras file."""
    out: Out
    """Folder of the surrogate to write."""

    def run(self) -> None:
        """Import."""
        from softfin.stages import offline as stages

        surrogate = stages.import_keras(
            self.posnet, self.forcenet, self.scalers, Path(self.out), overwrite=self.overwrite
        )
        counts = {
            "posnet": surrogate.posnet.config.parameters(),
            "forcenet": surrogate.forcenet.config.parameters(),
        }
        text = f"{self.out}: PosNet {counts['posnet']:,} and ForceNet {counts['forcenet']:,} parameters"
        self.tell({"surrogate": str(self.out), "parameters": counts, "limits": surrogate.limits.to_dict()}, text)
