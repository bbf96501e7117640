"""What the car's barriers take from the settings of its filter; the defaults fit the pymunk car."""

from __future__ import annotations

from typing import Final

from safedpa.barrier_setting import BarrierSetting

__all__ = ["BARRIER_SETTINGS"]

BARRIER_SETTINGS: Final = (
    BarrierSetting("braking_deceleration", "m/s2", 2.0, "what it can brake at least, with every load", positive=True),
    BarrierSetting("braking_gain", "1/s", 2.5, "of its speed servo at least, with every load", positive=True),
    BarrierSetting("clearance", "m", 0.05, "kept to obstacles and walls beyond its own radius"),
    BarrierSetting(
        "own_radius", "m", 0.0, "of the car's own body, of its footprint while it tows; 0: as the footprint's"
    ),
    BarrierSetting(
        "creeping", "s", 0.0, "m of h for each m/s below 0.1 m/s towards what no one sees: it creeps on; 0: it stands"
    ),
    BarrierSetting(
        "speed_low", "m/s", -0.8, "a little beyond the actuator's: driving at full speed is no conflict", signed=True
    ),
    BarrierSetting("speed_high", "m/s", 2.2, "likewise", signed=True, above="speed_low"),
)
