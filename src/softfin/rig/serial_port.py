"""Opening of a serial port, for devices that are connected by one."""

from typing import TYPE_CHECKING

from softfin.core.errors import DeviceError, one_line

if TYPE_CHECKING:
    import serial


def open_serial_port(
    port: str,
    baud: int,
    *,
    timeout_s: float,
    write_timeout_s: float | None = None,
    exclusive: bool = True,
) -> "serial.Serial":
    """Open a serial port; raises DeviceError.

    A read waits for up to `timeout_s`, a write for up to `write_timeout_s` (None: without limit).
    With `exclusive`, no other program may use the port.
    """
    # Imported here because it belongs to the extra `serial`, which not every rig needs.
    import serial

    try:
        return serial.Serial(
            port, baud, timeout=timeout_s, write_timeout=write_timeout_s, exclusive=exclusive
        )
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"serial port {port}: cannot be opened ({one_line(error)}); check the cable, port "
            "and your permission to use it, and end other programs that use it"
        ) from None
