"""Base models of the car and its limits."""
