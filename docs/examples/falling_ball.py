"""A ball that falls: a robot of one's own, with what it may lack, in one file."""

from safedpa.dynamics import AbstractBase
from safedpa.effects import Context, Parameter, RateEffect, Stage
from safedpa.systems import System, Variable

BALL = System(
    name="ball",
    state=(Variable("height", "m", -10.0, 1000.0), Variable("velocity", "m/s", -200.0, 200.0)),
    action=(),
)


class FreeFall(AbstractBase):
    """d(height)/dt = velocity, d(velocity)/dt = -gravity."""

    kind = "free_fall"
    equation = "height'' = -gravity"
    source = "Galilei, Discorsi, 1638"
    system = BALL
    parameters = (Parameter("gravity", "m/s2", 9.7, 9.9, 9.81, neutral=9.81),)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        return {"height": state["velocity"], "velocity": -parameters["gravity"]}


class QuadraticDrag(RateEffect):
    """d(velocity)/dt -= coefficient |velocity| velocity."""

    name = "quadratic_drag"
    robot = "ball"
    stage = Stage.RESISTANCE
    equation = "d(velocity)/dt -= coefficient |velocity| velocity"
    parameters = (Parameter("coefficient", "1/m", 0.0, 2.0, 0.05),)
    signature = "the faster it falls, the less it gains: deceleration with the square of the speed"
    source = "Hoerner, Fluid-Dynamic Drag, 1965, ch. 1"

    def modify(self, rates, parameters, context: Context):
        """The rates with drag, from those without it."""
        speed = context.state["velocity"]
        drag = parameters["coefficient"] * context.operations.absolute(speed) * speed
        return {**rates, "velocity": rates["velocity"] - drag}
