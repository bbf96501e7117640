"""Effects of the car: a table of those on commands (``channels``), a module for each other."""
