"""Effects of the differential drive: a table of those on commands (``channels``), a module for each other."""
