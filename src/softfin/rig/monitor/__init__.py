"""Live monitor of a recording, which follows the file on this or a different computer without
writing to it."""
