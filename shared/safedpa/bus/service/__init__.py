"""The loop of every service: states in, one decision a tick, a change of the model at a tick."""
