"""``softfin export``: a controller in, one step of it as ONNX out, for hosts without Python."""

from dataclasses import dataclass

from softfin.cli.common import Common
from softfin.cli.kinds import Controller, File


@dataclass(frozen=True, kw_only=True)
class Arguments(Common):
    """Write one step of a controller as ONNX, with its state as inputs and outputs; needs softfin[onnx]."""

    controller: Controller
    """Folder of the controller."""
    onnx: File
    """File to write; what its inputs mean is in its metadata."""

    def run(self) -> None:
        """Export."""
        from softfin.control.onnx import EPISODE, OPSET, export_onnx
        from softfin.control.store import load_controller

        exported = export_onnx(load_controller(self.controller), self.onnx, self.overwrite)
        summary = {"onnx": str(self.onnx), "opset": OPSET, **exported._asdict()}
        self.tell(
            summary,
            f"{self.onnx}: {exported.bytes:,} bytes, ONNX opset {OPSET}; over {EPISODE} actions onnxruntime's commands "
            f"differ from softfin's by {exported.worst:.1g} (rad, rad/s) at most\n"
            f"in:  {', '.join(exported.inputs)}\nout: {', '.join(exported.outputs)}",
        )
