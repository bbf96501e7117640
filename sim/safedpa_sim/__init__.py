"""The stand-in for the world: robots, training simulators, experiments."""
