"""Effects on the point robot's commands: thrust and turn."""

from safedpa.effects.channel_effects import EVERY, ChannelEffect
from safedpa.effects.parameter import Parameter

__all__ = ["EFFECTS"]

EFFECTS = (
    ChannelEffect(  # a slow link: all commands arrive late
        "point", "actuator_delay", EVERY, "delay", Parameter("seconds", "s", 0.0, 0.5, 0.1), called="action",
        signature="residuals of acceleration and turn rate after each change of command, both as if it had not been "
        "sent yet",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(
        "point", "actuator_gain", "thrust", "gain", Parameter("gain", "1", 0.1, 3.0, 0.8, neutral=1.0),
        signature="acceleration residual along the heading in proportion to the thrust",
        source="wear of a thruster; Chen and Patton, Robust Model-Based Fault Diagnosis, 1999, ch. 2",
    ),
)  # fmt: skip
