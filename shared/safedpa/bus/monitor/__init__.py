"""State of a fleet as a passive listener sees it, for people and metrics.

``fleet_state`` collects the newest messages, counts and rates per robot and process; ``alerts`` derives sentences about
problems from it. The monitor sends no commands, and no service waits for it. Read ``fleet_state.py`` first.
"""

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
