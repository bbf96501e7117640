"""The next experiment: what to drive so that the open question is decided."""
