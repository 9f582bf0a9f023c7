"""Emulated devices: they speak the drive's and the sensor's protocols, and the virtual tank moves
behind them."""
