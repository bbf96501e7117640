"""Effects of the pendulum, one a file."""
