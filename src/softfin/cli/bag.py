"""``softfin bag``: a recording that was cut off in, a whole one out; recordings in, logs or ROS 2 bags out."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from softfin.cli.common import Common, LogOptions, columns_read
from softfin.cli.kinds import File
from softfin.cli.options import Option
from softfin.core.errors import ConfigurationError
from softfin.data.issues import counted


@dataclass(frozen=True, kw_only=True)
class Arguments(LogOptions, Common):
    """Mend a bag that was cut off or damaged; turn recordings of any kind into Parquet logs or ROS 2 bags."""

    action: Annotated[Literal["recover", "convert"], Option(positional=True)]
    """recover: save what a damaged .mcap file holds. convert: write logs as .parquet or .mcap."""
    path: Annotated[Path, Option("RECORDING", positional=True)]
    """What to recover, a .mcap file; what to convert, a recording or a folder of them."""
    out: File | None = None
    """File to write; recover: NAME.recovered.mcap by default; convert: required, its suffix is the format."""
    ignore_errors: bool = False
    """Convert logs with errors, too."""

    def run(self) -> None:
        """Recover or convert."""
        if self.action == "recover":
            return self._recover()
        if self.out is None:
            raise ConfigurationError("convert needs --out: a .parquet or a .mcap file")
        from softfin.data.convert import convert

        result = convert(
            self.path, self.out, self.recordings, ignore_errors=self.ignore_errors, overwrite=self.overwrite
        )
        counts = ", ".join(counted(count, kind) for kind, count in result["counts"].items())
        text = f"{', '.join(result['files'])}: {result['rows']:,} rows; {counts}"
        return self.tell(result, f"{columns_read(result['columns'])}{text}")

    def _recover(self) -> None:
        from softfin.storage.bag.records import recover, recovered_path

        out = self.out or recovered_path(self.path)
        recovery = recover(self.path, out, self.overwrite)
        span = f"{counted(sum(recovery.messages.values()), 'message')} over {recovery.seconds:.1f} s"
        lost = sum(damage.length for damage in recovery.damages)
        reasons = "; ".join(dict.fromkeys(damage.reason for damage in recovery.damages))
        self.tell(
            {"recovered": None if recovery.whole else str(out), **recovery.to_dict()},
            f"{self.path}: whole already, {span}; nothing written" if recovery.whole
            else f"{out}: {span} saved; {lost:,} bytes could not be read ({reasons[:300]})",
        )  # fmt: skip
