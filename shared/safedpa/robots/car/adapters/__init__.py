"""Adapters of the car to other software: ``ros`` messages and ``gazebo`` plugin parameters."""
