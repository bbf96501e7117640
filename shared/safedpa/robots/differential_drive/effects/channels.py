"""Effects on the differential drive's commands: speed and turn rate."""

from safedpa.effects.channel_effects import EVERY, ChannelEffect
from safedpa.effects.parameter import Parameter

__all__ = ["EFFECTS"]

EFFECTS = (
    ChannelEffect(  # a slow link: all commands arrive late
        "differential_drive", "actuator_delay", EVERY, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1),
        called="action",
        signature="after each change of command speed and turn rate go on for a while as if nothing had been sent",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(  # both motors alike
        "differential_drive", "drive_lag", EVERY, "lag", Parameter("time_constant", "s", 0.0, 2.0, 0.15),
        called="action",
        signature="residuals of acceleration after each change of a command, against the change, dying out",
        source="Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    ),
)  # fmt: skip
