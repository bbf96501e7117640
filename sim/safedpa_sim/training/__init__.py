"""Training of learned models on batched simulators, in the paper's phases."""
