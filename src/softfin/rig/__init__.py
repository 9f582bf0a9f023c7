"""Real fins: drives, sensors, session, safety, monitor."""
