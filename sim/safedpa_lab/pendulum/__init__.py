"""The pendulum's experiments: methods, recovery, invariance, crossing, its margin."""
