"""Scenes of the car: obstacles that are given, perceived and sensed."""
