"""``softfin import-keras``: published nets in, a surrogate out."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from softfin import stages
from softfin.cli.common import Common, Out


@dataclass(frozen=True, kw_only=True)
class Arguments(Common):
    """Turn two Keras 2 nets and their scalers into a surrogate; needs no TensorFlow and reads no pickle."""

    posnet: tyro.conf.Positional[Path]
    """PosNet's .keras file."""
    forcenet: tyro.conf.Positional[Path]
    """ForceNet's .keras file."""
    scalers: Path
    """JSON of {channel: {scale, offset, data_min, data_max}}."""
    out: Out
    """Folder of the surrogate to write."""

    def run(self) -> None:
        """Import."""
        surrogate = stages.import_keras(
            self.posnet, self.forcenet, self.scalers, Path(self.out), overwrite=self.overwrite
        )
        counts = {
            "posnet": surrogate.posnet.config.parameters(),
            "forcenet": surrogate.forcenet.config.parameters(),
        }
        text = f"{self.out}: PosNet {counts['posnet']:,} and ForceNet {counts['forcenet']:,} parameters"
        self.tell({"surrogate": str(self.out), "parameters": counts, "limits": surrogate.limits.described()}, text)
