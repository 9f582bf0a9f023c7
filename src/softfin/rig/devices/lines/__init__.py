"""Any force sensor that sends one line of text per sample over a serial port or UDP."""
