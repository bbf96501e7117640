"""Effects on the pendulum's command: the torque of its motor."""

from safedpa.effects.channel_effects import ChannelEffect
from safedpa.effects.parameter import Parameter

__all__ = ["EFFECTS"]

EFFECTS = (
    ChannelEffect(
        "pendulum", "torque_delay", "torque", "delay", Parameter("seconds", "s", 0.0, 0.2, 0.02),
        signature="rate residual after each change of torque, as if the command had not been sent yet, then none",
        source="dead time; Astrom and Murray, Feedback Systems, 2nd ed., ch. 9",
    ),
    ChannelEffect(
        "pendulum", "torque_gain", "torque", "gain", Parameter("gain", "1", 0.1, 3.0, 0.85, neutral=1.0),
        signature="rate residual in proportion to the torque",
        source="torque constant of the motor; Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022",
    ),
    ChannelEffect(
        "pendulum", "torque_lag", "torque", "lag", Parameter("time_constant", "s", 0.0, 1.0, 0.02),
        signature="rate residual after each change of torque, of opposite sign to the change, dying out",
        source="Astrom and Murray, Feedback Systems, 2nd ed., ch. 3",
    ),
    ChannelEffect(
        "pendulum", "torque_offset", "torque", "offset", Parameter("offset", "N m", -5.0, 5.0, 0.1),
        mirrored=("offset",),
        signature="rate residual of one size and sign, whatever angle, rate and torque",
        source="Wiebe et al., Torque-limited simple pendulum, JOSS 7(74), 2022",
    ),
)  # fmt: skip
