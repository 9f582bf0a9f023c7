"""Live monitor of a recording: follows its file, on this computer or another, without writing to
it."""
