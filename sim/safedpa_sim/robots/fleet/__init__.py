"""Many simulated cars in one process, for load tests: ``__main__`` is the command, ``loop`` its control loop."""
