"""Barriers of the car. Read ``obstacles`` first."""
