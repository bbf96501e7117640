"""The perception service, which finds obstacles in laser scans; its node is in ``safedpa.perception``."""
