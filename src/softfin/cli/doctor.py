"""``doctor`` checks the computer and the installation, and suggests fixes."""

from softfin.cli.common import CommandOptions
from softfin.core.errors import RunError
from softfin.doctor import examine


class DoctorArguments(CommandOptions):
    """Check the installation, JAX, the disk and the ports of this computer; nothing moves. Paste
    the output into bug reports. For a rig, use softfin rig check."""

    def __call__(self) -> None:
        if wrong := self.tell_findings(examine()):
            raise RunError(f"failed: {wrong}")
