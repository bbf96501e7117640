"""All inputs of the gateway from ROS, in one record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from safedpa_services.ros_gateway.publisher_monitor import CommandEchoMonitor
from safedpa_services.ros_gateway.sensor_inputs import FootprintInput, LatestMessage, NominalInput, TransformListener
from safedpa_services.ros_gateway.simulated_clock import SimulatedClock
from safedpa_services.ros_gateway.sources import SourceReceiver
from safedpa_services.ros_gateway.speed_zones import SpeedZones, ToggleInput


@dataclass(frozen=True)
class SensorInputs:
    """All inputs of the gateway from ROS; None for topics that the robot's file does not name."""

    odometry: LatestMessage
    driver: CommandEchoMonitor
    nominal: NominalInput | None = None
    goal: LatestMessage | None = None
    localised: TransformListener | None = None
    sources: tuple[SourceReceiver, ...] = ()
    footprint: FootprintInput | None = None
    zones: SpeedZones | None = None
    counted: Mapping[str, ToggleInput] = field(default_factory=dict)
    """Whether a source counts in the zones, by its name; missing: it does."""
    simulated: SimulatedClock | None = None

    @property
    def refused(self) -> int:
        """Number of refused messages."""
        inputs = (self.odometry, self.nominal, self.goal, self.localised, self.footprint, *self.sources)
        return sum(one.refused for one in inputs if one is not None)

    def refusals(self, scans: Sequence[str]) -> dict[str, str]:
        """Returns why the newest messages were refused, by input; sources are named by ``scans``."""
        named = dict(zip(scans, self.sources, strict=True))
        inputs = {"goal": self.goal, "nominal": self.nominal, "footprint": self.footprint, **named}
        return {f"{name}_refused": one.why for name, one in inputs.items() if one is not None and one.why}
