"""Effects on the car's commands: drive (a speed or a throttle) and steer."""

from safedpa.effects.channel_effects import EVERY, ChannelEffect
from safedpa.effects.parameter import Parameter

_DRIVE = ("throttle", "target_speed")
"""A car has one of them: a motor's throttle, or the command of a speed servo."""
_DART = "Lyons et al., DART, IEEE Intelligent Vehicles Symposium 2024"
_MURRAY = "Astrom and Murray, Feedback Systems, 2nd ed., ch. 3"
_DEAD_TIME = "dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9"

EFFECTS = (
    ChannelEffect(  # a slow link: all commands arrive late
        "car", "actuator_delay", EVERY, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1), called="action",
        signature="residuals of acceleration and yaw rate after each change of command, both as if it had not been "
        "sent yet",
        source=_DEAD_TIME,
    ),
    ChannelEffect(
        "car", "drive_dead_zone", "throttle", "dead_zone", Parameter("width", "1", 0.0, 0.9, 0.15), needs=("throttle",),
        signature="acceleration residual against the throttle: grows with it up to a width, then of one size",
        source=f"{_DART}; Tao and Kokotovic, Adaptive Control of Systems, 1996, ch. 2",
    ),
    ChannelEffect(
        "car", "drive_delay", _DRIVE, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1), called="drive",
        signature="acceleration residual after each change of the drive, as if the command had not been sent yet, "
        "then none",
        source=_DEAD_TIME,
    ),
    ChannelEffect(
        "car", "drive_lag", _DRIVE, "lag", Parameter("time_constant", "s", 0.0, 2.0, 0.15), called="drive",
        signature="acceleration residual after each change of the drive, of opposite sign to the change, dying out",
        source=f"{_MURRAY}; {_DART} (throttle dynamics)",
    ),
    ChannelEffect(  # of a speed servo only: for a throttle this would be the base's drive_gain
        "car", "speed_command_gain", "target_speed", "gain", Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),
        needs=("target_speed",),
        signature="settled speed differs from the commanded one by the same share at every speed",
        source=f"static gain of a servo; {_MURRAY}",
    ),
    ChannelEffect(
        "car", "steering_delay", "steer", "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1),
        signature="yaw-rate residual after each change of steer, as if the command had not been sent yet, then none",
        source=_DEAD_TIME,
    ),
    ChannelEffect(
        "car", "steering_gain", "steer", "gain", Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),
        signature="yaw-rate residual in proportion to the commanded yaw rate, the same share at every speed",
        source=f"{_DART}, steering model",
    ),
    ChannelEffect(
        "car", "steering_lag", "steer", "lag", Parameter("time_constant", "s", 0.0, 1.0, 0.15),
        signature="yaw-rate residual after each change of steer, of opposite sign to the change, dying out",
        source="first-order actuator; Astrom and Murray, Feedback Systems, ch. 3",
    ),
    ChannelEffect(
        "car", "steering_offset", "steer", "offset", Parameter("angle", "rad", -0.3, 0.3, 0.03), mirrored=("angle",),
        signature="yaw-rate residual in proportion to the speed, the same for left, right and straight",
        source=f"{_DART}, steering model",
    ),
    ChannelEffect(
        "car", "steering_saturation", "steer", "limit",
        Parameter(
            "limit", "rad", 0.02, 1.5, 0.3, neutral=1.5, meaning="neutral: beyond every steer that the car accepts"
        ),
        signature="yaw-rate residual only beyond one angle of steer, growing with the excess, on both sides",
        source=f"{_DART}, steering model (the curve flattens at the stops)",
    ),
)  # fmt: skip
