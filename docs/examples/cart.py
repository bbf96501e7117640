"""A cart on a rail, of which a throttle and a speed are recorded and nothing else: an action, a memory, a delay."""

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

CART = System(
    name="cart",
    state=(Variable("speed", "m/s", -10.0, 10.0),),
    action=(Variable("throttle", "1", -1.0, 1.0),),
)


class Rail(AbstractBase):
    """d(speed)/dt = drive_gain throttle."""

    kind = "rail"
    equation = "d(speed)/dt = drive_gain throttle"
    source = "Newton, Principia, 1687"
    system = CART
    parameters = (Parameter("drive_gain", "m/s2", 0.1, 50.0, 3.0, neutral=None),)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        return {"speed": parameters["drive_gain"] * action["throttle"]}


EFFECTS = general_effects(CART, moving={"speed": 1.0})  # usual: 1 m/s
