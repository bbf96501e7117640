"""The stand-in for the world: robots, and the simulators that policies are trained in."""
