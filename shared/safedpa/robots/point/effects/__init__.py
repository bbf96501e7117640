"""Effects of the point robot, one a file."""
