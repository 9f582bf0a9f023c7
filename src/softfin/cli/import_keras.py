"""``softfin import-keras``: published nets in, a surrogate out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from softfin.cli.common import Common
from softfin.cli.kinds import File, Out
from softfin.cli.options import Option


@dataclass(frozen=True, kw_only=True)
class Arguments(Common):
    """Turn two Keras 2 nets and their scalers into a surrogate; needs no TensorFlow and reads no pickle."""

    scalers: File
    """JSON of {channel: {scale, offset, data_min, data_max}}."""
    posnet: Annotated[Path, Option("POSNET", positional=True)]
    """PosNet's .keras file."""
    forcenet: Annotated[Path, Option("FORCENET", positional=True)]
    """ForceNet's .keras file."""
    out: Out
    """Folder of the surrogate to write."""

    def run(self) -> None:
        """Import."""
        from softfin.stages.fit import import_keras

        surrogate = import_keras(self.posnet, self.forcenet, self.scalers, self.out, overwrite=self.overwrite)
        nets = {"posnet": surrogate.posnet, "forcenet": surrogate.forcenet}
        counts = {name: net.config.parameters() for name, net in nets.items()}
        text = f"{self.out}: PosNet {counts['posnet']:,} and ForceNet {counts['forcenet']:,} parameters"
        self.tell({"surrogate": str(self.out), "parameters": counts, "limits": surrogate.limits.to_dict()}, text)
