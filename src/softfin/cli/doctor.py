"""``doctor`` checks the computer and the installation, and suggests fixes."""

from softfin.cli.common import CommandOptions, YamlFile
from softfin.core.errors import RunError
from softfin.rig.doctor import examine


class DoctorArguments(CommandOptions):
    """Check the installation, devices, disk and bus of this computer; nothing moves. Paste the
    output into bug reports."""

    rig: YamlFile | None = None
    """Also check the drive and the sensor of this rig, as softfin rig check does."""

    def __call__(self) -> None:
        if wrong := self.tell_findings(examine(self.rig)):
            raise RunError(f"failed: {wrong}")
