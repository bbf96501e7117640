"""What the barriers of a differential drive take from its filter's settings; the defaults fit the simulated one."""

from __future__ import annotations

from typing import Final

from safedpa.barrier_setting import BarrierSetting

__all__ = ["BARRIER_SETTINGS"]

BARRIER_SETTINGS: Final = (
    BarrierSetting("braking_deceleration", "m/s2", 0.7, "of a wheel, with every load that is driven", positive=True),
    BarrierSetting("braking_gain", "1/s", 5.0, "of a wheel's servo, likewise", positive=True),
    BarrierSetting("clearance", "m", 0.03, "kept to obstacles and walls beyond its own radius"),
    BarrierSetting("speed_low", "m/s", -0.3, "a little beyond the actuators'", signed=True),
    BarrierSetting("speed_high", "m/s", 0.65, "likewise", signed=True, above="speed_low"),
)
