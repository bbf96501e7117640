"""Where a model fails: measured windows, open-loop rollouts, errors by state, run, place, speed and time."""
