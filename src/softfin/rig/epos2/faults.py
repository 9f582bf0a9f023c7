"""What an EPOS2 says is wrong: emergency codes and SDO aborts, each one line with its name and the way out.

Codes: maxon "EPOS2 Firmware Specification" (rel5466) and CiA 301; the ways out are ours.
"""

FAULTS = {
    0x1000: ("generic error", "switch the drive off and on"),
    0x2310: ("over-current", "look for a short circuit or a blocked fin; lower the acceleration"),
    0x3210: ("over-voltage", "look at the supply; brake more gently, or add a brake resistor"),
    0x3220: ("under-voltage", "look at the supply: its voltage fell below what the drive needs"),
    0x4210: ("over-temperature", "let the drive cool down; move less or slower"),
    0x5113: ("+5 V supply too low", "look for a short circuit in the encoder's cable"),
    0x5114: ("supply of the output stage too low", "look at the supply and at its fuse"),
    0x6100: ("internal software error", "switch the drive off and on; update its firmware if it comes again"),
    0x6320: ("software parameter error", "restore the drive's defaults in EPOS Studio and tune it again"),
    0x7320: ("position sensor error", "look at the encoder and its cable; its lines must be those of the drive"),
    0x8110: ("CAN overrun, objects lost", "put fewer nodes or a higher bitrate on the bus"),
    0x8111: ("CAN overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x8120: ("CAN error passive", "look at the bus: termination, bitrate, cable"),
    0x8130: ("heartbeat of the host lost", "find out why the program hung or was killed; look at the bus's cable"),
    0x8150: ("CAN message collision", "look for a second drive with the same node number"),
    0x81FD: ("CAN bus off", "look at the bus: termination, bitrate, cable"),
    0x81FE: ("CAN receive queue overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x81FF: ("CAN transmit queue overrun", "put fewer nodes or a higher bitrate on the bus"),
    0x8210: ("process data of a wrong length", "look for another program that writes to the same drive"),
    0x8611: ("following error", "look for a blocked fin; ask for less velocity or acceleration, or tune the drive"),
    0xFF01: ("hall sensor error", "look at the hall sensors' cable"),
    0xFF02: ("index processing error", "look at the encoder's index channel"),
    0xFF03: ("encoder resolution error", "set the encoder's lines in the drive to those of the encoder"),
    0xFF04: ("hall sensor not found", "look at the hall sensors' cable"),
    0xFF06: ("negative limit switch", "turn the fin away from its end"),
    0xFF07: ("positive limit switch", "turn the fin away from its end"),
    0xFF08: ("hall angle detection error", "look at the hall sensors' cable and at the motor's pole pairs"),
    0xFF09: ("software position limit", "turn the fin inside its limits, or zero it anew"),
    0xFF0A: ("position sensor breach", "look at the encoder and its cable"),
    0xFF0B: ("system overloaded", "look for too many messages on the bus"),
}

ABORTS = {
    0x05030000: ("toggle bit not alternated", "look at the bus's cable"),
    0x05040000: ("protocol timed out", "look at the bus's load and cable"),
    0x05040001: ("command unknown", "look for another program on the same bus"),
    0x06010000: ("access not supported", "the drive's firmware is not one that softfin knows"),
    0x06010001: ("object can only be written", "the drive's firmware is not one that softfin knows"),
    0x06010002: ("object can only be read", "the drive's firmware is not one that softfin knows"),
    0x06020000: ("object does not exist", "the device is no EPOS2, or its firmware is too old"),
    0x06040041: ("object cannot be mapped to process data", "update the drive's firmware"),
    0x06040042: ("process data would be too long", "update the drive's firmware"),
    0x06040043: ("parameters do not fit each other", "restore the drive's defaults in EPOS Studio"),
    0x06060000: ("hardware error", "switch the drive off and on"),
    0x06070010: ("wrong length of data", "the device is no EPOS2, or its firmware is too old"),
    0x06090011: ("sub-index does not exist", "the device is no EPOS2, or its firmware is too old"),
    0x06090030: ("value out of range", "change the value in the rig's file to one that the drive takes"),
    0x06090031: ("value too large", "change the value in the rig's file to one that the drive takes"),
    0x06090032: ("value too small", "change the value in the rig's file to one that the drive takes"),
    0x08000000: ("general error", "switch the drive off and on"),
    0x08000020: ("cannot be stored", "switch the drive off and on"),
    0x08000022: ("not in the present state", "disable the drive first, or switch it off and on"),
    0x0F00FFB9: ("wrong node number", "set the drive's node in the rig's file to that of its switches"),
    0x0F00FFBC: ("not in service mode", "switch the drive off and on"),
    0x0F00FFBE: ("password is not correct", "close EPOS Studio, switch the drive off and on"),
    0x0F00FFBF: ("command illegal", "the drive's firmware is not one that softfin knows"),
    0x0F00FFC0: ("wrong NMT state", "switch the drive off and on"),
}


def fault_line(code: int) -> str:
    """Such as ``drive fault 0x8611, following error: look for a blocked fin; ..``."""
    name, way_out = FAULTS.get(code, ("not in softfin's list", "look it up in the EPOS2 Firmware Specification"))
    return f"drive fault 0x{code:04X}, {name}: {way_out}"


def abort_line(code: int) -> str:
    """Such as ``0x06020000, object does not exist: the device is no EPOS2, ..``."""
    name, way_out = ABORTS.get(code, ("not in softfin's list", "look it up in the EPOS2 Communication Guide"))
    return f"0x{code:08X}, {name}: {way_out}"
