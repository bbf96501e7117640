"""The policy service, which requests actions; its node is in ``safedpa.policy``."""
