"""What a listener on the bus knows of a fleet, for people and for metrics: it commands nothing, nobody waits for it."""

from safedpa.bus.overview.concerns import Concern, concerns_of, fleet_concerns
from safedpa.bus.overview.fleet import FleetOverview
from safedpa.bus.overview.recent import Recent
from safedpa.bus.overview.robot import RobotOverview
from safedpa.bus.overview.service import ServiceOverview

__all__ = [
    "Concern",
    "FleetOverview",
    "Recent",
    "RobotOverview",
    "ServiceOverview",
    "concerns_of",
    "fleet_concerns",
]
