"""The force-tracking task: references, cells, reward, observation."""
