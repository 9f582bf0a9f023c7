"""Controllers: they turn a reference force into commands, three times a second."""
