"""Effects of the differential drive, one a file."""
