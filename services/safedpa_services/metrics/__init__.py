"""What is said on the bus, as metrics in Prometheus's format: one process alongside the loop, which waits for nothing."""
