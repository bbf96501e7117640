"""State of a fleet as a passive listener sees it, for people and metrics.

``fleet_state`` collects the newest messages, counts and rates per robot and process; ``alerts`` derives sentences about
problems from it. ``roster`` holds who should be there, and ``measurement_times`` when a message was measured. The
monitor sends no commands, and no service waits for it. Read ``fleet_state.py`` first.
"""

from safedpa.bus.monitor.alerts import Alert, fleet_alerts, robot_alerts
from safedpa.bus.monitor.fleet_state import FleetOverview, RobotOverview, ServiceOverview, SlidingCounter
from safedpa.bus.monitor.measurement_times import MeasurementTimes
from safedpa.bus.monitor.present import age_text, headline, is_stale
from safedpa.bus.monitor.roster import SILENT_SECONDS, Incident, Member, Roster

__all__ = [
    "SILENT_SECONDS",
    "Alert",
    "FleetOverview",
    "Incident",
    "MeasurementTimes",
    "Member",
    "RobotOverview",
    "Roster",
    "ServiceOverview",
    "SlidingCounter",
    "age_text",
    "fleet_alerts",
    "headline",
    "is_stale",
    "robot_alerts",
]
