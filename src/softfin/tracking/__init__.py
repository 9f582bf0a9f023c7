"""The force-tracking task: hold a reference force on average, smoothly, by commanding a plant three times a second."""
