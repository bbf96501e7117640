"""The services, each its own process, and the command line."""
