"""Effects of the pendulum: a table of those on commands (``channels``), a module for each other."""
