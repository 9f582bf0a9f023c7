"""``doctor`` checks the computer and the installation, and says what is wrong and how to fix it."""

from softfin.cli.common import CommandOptions, YamlFile
from softfin.core.errors import RunError
from softfin.rig.doctor import examine


class DoctorArguments(CommandOptions):
    """Check the installation, devices, disk and bus of this computer. Paste the output into an
    issue; nothing moves."""

    rig: YamlFile | None = None
    """Also check the drive and the sensor of this rig, as softfin rig check does."""

    def __call__(self) -> None:
        if wrong := self.tell_findings(examine(self.rig)):
            raise RunError(f"failed: {wrong}")
