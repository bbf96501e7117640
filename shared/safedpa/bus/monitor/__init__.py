"""What a listener on the bus knows of a fleet, for people and for metrics: it commands nothing, no one waits for it."""

from safedpa.bus.monitor.alerts import Alert, fleet_alerts, robot_alerts
from safedpa.bus.monitor.fleet_state import FleetOverview, RobotOverview, ServiceOverview, SlidingCounter

__all__ = [
    "Alert",
    "FleetOverview",
    "RobotOverview",
    "ServiceOverview",
    "SlidingCounter",
    "fleet_alerts",
    "robot_alerts",
]
