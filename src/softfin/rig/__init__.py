"""Real time: drive and force sensor, real or emulated; session, safety, recording, monitor."""
