"""``softfin bag``: a recording that was cut off in, a whole one out; recordings in, logs or ROS 2 bags out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from softfin.cli.common import Common
from softfin.cli.kinds import File
from softfin.cli.log_options import LogOptions, columns_read
from softfin.cli.options import Option
from softfin.core.errors import ConfigurationError
from softfin.data.issues import counted
from softfin.storage import paths


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Mend a bag that was cut off or damaged; turn recordings of any kind into Parquet logs or ROS 2 bags."""

    action: Annotated[Literal["recover", "convert"], Option(positional=True)]
    """recover: save what a damaged .mcap file holds. convert: write logs as .parquet or .mcap."""
    path: Annotated[Path, Option("RECORDING", positional=True)]
    """What to recover, a .mcap file; what to convert, a recording or a folder of them."""
    out: File | None = None
    """What to write: of recover NAME.recovered.mcap beside it; convert must be told, and its ending says the kind."""
    ignore_errors: bool = False
    """Convert logs with errors, too."""

    def check(self) -> None:
        """Whether the recording is there."""
        super().check()
        if self.action == "recover":
            paths.check_recoverable(self.path)
        elif self.out is None:
            raise ConfigurationError("convert needs --out: a .parquet or a .mcap file")
        else:
            paths.find_recordings(self.path)

    def run(self) -> None:
        """Recover or convert."""
        if self.action == "recover":
            self._recover()
        else:
            self._convert()

    def _recover(self) -> None:
        from softfin.storage.bag.recovery import recover, recovered_path

        out = self.out or recovered_path(self.path)
        recovery = recover(self.path, out, self.overwrite)
        messages = counted(sum(recovery.messages.values()), "message")
        span = f"{messages} over {recovery.seconds:.1f} s"
        result = {"recovered": None if recovery.whole else str(out), **recovery.to_dict()}
        if recovery.whole:
            self.tell(result, f"{self.path}: whole already, {span}; nothing written")
            return
        lost = sum(damage.length for damage in recovery.damages)
        reasons = "; ".join(dict.fromkeys(damage.reason for damage in recovery.damages))
        self.tell(result, f"{out}: {span} saved; {lost:,} bytes could not be read ({reasons[:300]})")

    def _convert(self) -> None:
        from softfin.data.convert import convert

        assert self.out is not None
        result = convert(
            self.path, self.out, self.import_config(), ignore_errors=self.ignore_errors, overwrite=self.overwrite
        )
        counts = ", ".join(counted(count, kind) for kind, count in result["counts"].items())
        self.tell(
            result, f"{columns_read(result['columns'])}{', '.join(result['files'])}: {result['rows']:,} rows; {counts}"
        )
