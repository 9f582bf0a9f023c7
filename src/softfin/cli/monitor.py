"""``softfin monitor``: a recording while it is made in, its state on the terminal or as a page out; it only reads."""

import contextlib
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from rich.console import Console

from softfin.cli.common import CommandOptions
from softfin.cli.options import Option
from softfin.core.choices import LOOPBACK
from softfin.rig.monitor.follow import Follower
from softfin.rig.monitor.terminal import watch
from softfin.rig.monitor.web import Server


@dataclass(frozen=True, kw_only=True)
class Arguments(CommandOptions):
    """Watch a recording while it is made; Ctrl-C ends the watching, never the recording."""

    run_folder: Annotated[Path, Option("RECORDING", positional=True)]
    """A bag (.mcap), or a folder that bags are written to: its newest is followed, and the next one when it comes."""
    web: bool = False
    """As a page in the browser, with live traces."""
    port: int = 8080
    """Port of the page; 0 takes a free one."""
    host: str = LOOPBACK
    """Address that the page is served on; on another one than this, whoever reaches it sees the recording."""
    json: bool = False
    """Print the state of the recording as JSON, once."""

    def run(self) -> None:
        """Monitor."""
        follower = Follower(self.run_folder)
        # Whoever watches has lost nothing by stopping: exit code 0.
        with contextlib.suppress(KeyboardInterrupt):
            if self.json:
                follower.poll()
                while (summary := follower.summary())["state"] == "reading" and summary["problem"] is None:
                    follower.poll()
                sys.stdout.write(json.dumps(summary, indent=2, allow_nan=False) + "\n")
            elif self.web:
                with Server(follower, self.host, self.port) as server:
                    if self.host not in (LOOPBACK, "::1", "localhost"):
                        sys.stderr.write(f"warning: {self.host}: others can watch too; no password\n")
                    sys.stderr.write(f"{server.address} shows the recording; Ctrl-C ends\n")
                    server.serve_forever()
            else:
                watch(follower, Console(), sleep=time.sleep)
