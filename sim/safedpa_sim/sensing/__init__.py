"""Simulated sensing: ``laser`` scanners, ``people`` who walk on the field, and the ``shapes`` that rays hit.

Read ``sensor_inputs`` first: it combines them for one car.
"""

from safedpa_sim.sensing.laser import Laser, LaserSettings
from safedpa_sim.sensing.people import Person, StepsOut, Walks

__all__ = ["Laser", "LaserSettings", "Person", "StepsOut", "Walks"]
