"""An emulated EPOS2: object dictionary, states, motion and CAN communication."""
