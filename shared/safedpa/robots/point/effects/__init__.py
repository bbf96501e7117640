"""Effects of the point robot: a table of those on commands (``channels``), a module for each other."""
