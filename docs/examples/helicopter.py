"""A laboratory helicopter with two axes: two rotors lift and turn a beam; rotors follow their volts with a lag."""

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

HELICOPTER = System(
    name="helicopter",
    state=(
        Variable("pitch", "rad", -1.5, 1.5, angle=True),
        Variable("yaw", "rad", -1e3, 1e3, angle=True),
        Variable("pitch_rate", "rad/s", -20.0, 20.0),
        Variable("yaw_rate", "rad/s", -20.0, 20.0),
    ),
    action=(Variable("main", "V", -24.0, 24.0), Variable("tail", "V", -15.0, 15.0)),
)


class Beam(AbstractBase):
    """d(pitch_rate)/dt = lift main - weight cos(pitch); d(yaw_rate)/dt = turn tail + cross main."""

    kind = "beam"
    equation = "pitch'' = lift main - weight cos(pitch), yaw'' = turn tail + cross main"
    source = "Quanser 2 DOF Helicopter, laboratory manual (linear in the volts)"
    system = HELICOPTER
    parameters = (
        Parameter("lift", "rad/s2/V", 0.01, 20.0, 0.6, neutral=None),
        Parameter("turn", "rad/s2/V", 0.01, 20.0, 0.8, neutral=None),
        Parameter("cross", "rad/s2/V", -5.0, 5.0, 0.1),
        Parameter("weight", "rad/s2", 0.0, 50.0, 3.0),
    )

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        return {
            "pitch": state["pitch_rate"],
            "yaw": state["yaw_rate"],
            "pitch_rate": parameters["lift"] * action["main"] - parameters["weight"] * operations.cos(state["pitch"]),
            "yaw_rate": parameters["turn"] * action["tail"] + parameters["cross"] * action["main"],
        }


EFFECTS = general_effects(HELICOPTER, moving={"pitch_rate": 0.5, "yaw_rate": 0.5})
