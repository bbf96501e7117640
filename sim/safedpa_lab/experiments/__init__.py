"""Experiments: what the product shows, measured by a command, with seeds."""
