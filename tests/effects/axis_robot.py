"""An axis of a robot as a user declares it: what ``test_recovery`` hides effects in."""

from typing import Any

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

GAIN, LOSS = 4.0, 1.0

AXIS = System(
    "recovery_axis",
    (Variable("angle", "rad", -60.0, 60.0), Variable("rate", "rad/s", -40.0, 40.0)),
    (Variable("torque", "N m", -1.0, 1.0), Variable("battery", "V", 8.0, 14.0)),
)


class Axis(AbstractBase):
    """rate' = gain torque - loss rate."""

    kind, equation, source, system = "recovery_axis", "rate' = gain torque - loss rate", "Newton", AXIS
    parameters = (Parameter("gain", "1", 0.1, 50.0, GAIN, GAIN), Parameter("loss", "1/s", 0.0, 9.0, LOSS, LOSS))

    def rates(self, state: Any, action: Any, parameters: Any, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        pull = parameters["gain"] * action["torque"] - parameters["loss"] * state["rate"]
        return {"angle": state["rate"], "rate": pull}


EFFECTS = general_effects(AXIS, moving={"rate": 2.0}, supply={"battery": 11.0})
