"""``doctor`` checks the computer and the installation, and says what is wrong and how to fix it."""

import sys

from softfin.cli.common import CommandOptions, YamlFile
from softfin.cli.rig import MARKS
from softfin.core.errors import RunError
from softfin.core.printable import printable
from softfin.rig.doctor import examine


class DoctorArguments(CommandOptions):
    """Check the installation, devices, disk and bus of this computer. Paste the output into an
    issue; nothing moves."""

    rig: YamlFile | None = None
    """Also check the drive and the sensor of this rig, as softfin rig check does."""

    def __call__(self) -> None:
        results = []
        for result in examine(self.rig):
            results.append(result)
            if not self.json_:
                sys.stdout.write(
                    f"{MARKS[result.state]:>6}  {result.what:14} {printable(result.text)}\n"
                )
                sys.stdout.flush()
        if self.json_:
            self.tell([result._asdict() for result in results], "")
        wrong = [result.what for result in results if result.state == "wrong"]
        if wrong:
            raise RunError(f"failed: {', '.join(wrong)}")
