"""What a simulated robot senses with: laser scanners, things of any shape to see, and people who walk among them."""

from safedpa_sim.sensing.laser import Laser, LaserSettings
from safedpa_sim.sensing.people import Person, StepsOut, Walks

__all__ = ["Laser", "LaserSettings", "Person", "StepsOut", "Walks"]
