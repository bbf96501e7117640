"""The filter settings of the car's barriers; the defaults fit the simulated car."""

from __future__ import annotations

from typing import Final

from safedpa.barrier_setting import BarrierSetting

BARRIER_SETTINGS: Final = (
    BarrierSetting("braking_deceleration", "m/s2", 2.0, "guaranteed braking with every load", positive=True),
    BarrierSetting("braking_gain", "1/s", 2.5, "least gain of the speed servo, with every load", positive=True),
    BarrierSetting("clearance", "m", 0.05, "distance kept from obstacles and walls beyond the radius"),
    BarrierSetting(
        "own_radius", "m", 0.0, "radius of the car's own body, for movers while it tows; 0: that of the footprint"
    ),
    BarrierSetting(
        "creeping", "s", 0.0, "h in m per m/s below 0.1 m/s towards hidden areas, which lets the car creep; 0: it stops"
    ),
    BarrierSetting(
        "speed_low", "m/s", -0.8, "slightly beyond the actuator limit, so that full speed is permitted", signed=True
    ),
    BarrierSetting("speed_high", "m/s", 2.2, "slightly beyond the actuator limit", signed=True, above="speed_low"),
)
