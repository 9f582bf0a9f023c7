"""Real fins: drives, sensors, session, safety and monitor."""
