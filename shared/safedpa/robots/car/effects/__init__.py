"""Effects of the car, one a file."""
