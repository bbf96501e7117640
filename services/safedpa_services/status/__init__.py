"""The state of a fleet, for a person at a terminal and for a script."""
