"""``doctor`` examines the computer and the installation: what is well, what is not, and what to do
about it."""

from softfin.cli.common import CommandOptions, YamlFile
from softfin.core.errors import RunError
from softfin.rig.doctor import examine


class DoctorArguments(CommandOptions):
    """Check the installation, devices, disk and bus of this computer. Paste the output into an
    issue; nothing moves."""

    rig: YamlFile | None = None
    """File of a rig whose drive and sensor are checked, too, as by softfin rig check."""

    def __call__(self) -> None:
        if wrong := self.tell_findings(examine(self.rig)):
            raise RunError(f"not well: {wrong}")
