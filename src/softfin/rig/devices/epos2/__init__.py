"""The drive: a maxon EPOS2 over CANopen."""
