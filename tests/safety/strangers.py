"""Two robots that do not ship, declared as the page on a robot of one's own says."""

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter
from safedpa.systems import System, Variable

DRONE = System(
    name="drone",
    state=(
        *(Variable(axis, "m", -1e4, 1e4) for axis in ("x", "y", "z")),
        *(Variable(rate, "m/s", -50.0, 50.0) for rate in ("vx", "vy", "vz")),
    ),
    action=(Variable("ax", "m/s2", -5.0, 5.0), Variable("ay", "m/s2", -5.0, 5.0)),
)

DIFFERENTIAL = System(
    name="differential",
    state=(Variable("x", "m", -1e4, 1e4), Variable("y", "m", -1e4, 1e4), Variable("yaw", "rad", -1e4, 1e4, angle=True)),
    action=(Variable("v", "m/s", -2.0, 2.0), Variable("omega", "rad/s", -3.0, 3.0)),
)

_SHARE = Parameter("share", "1", 0.5, 2.0, 1.0, neutral=1.0)


class Hover(AbstractBase):
    """d(velocity)/dt = the acceleration that was asked for, height held."""

    kind = "hover"
    equation = "d(vx, vy)/dt = share (ax, ay)"
    source = "Newton"
    system = DRONE
    parameters = (_SHARE,)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        share = parameters["share"]
        return {
            "x": state["vx"], "y": state["vy"], "z": state["vz"], "vx": share * action["ax"],
            "vy": share * action["ay"], "vz": -state["vz"],
        }  # fmt: skip


class TwoWheels(AbstractBase):
    """Two driven wheels: speed and turn rate as commanded."""

    kind = "two_wheels"
    equation = "d(x, y)/dt = v (cos yaw, sin yaw), d(yaw)/dt = omega"
    source = "Siegwart, Introduction to Autonomous Mobile Robots, 2011, ch. 3"
    system = DIFFERENTIAL
    parameters = (_SHARE,)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        speed = parameters["share"] * action["v"]
        return {
            "x": speed * operations.cos(state["yaw"]),
            "y": speed * operations.sin(state["yaw"]),
            "yaw": action["omega"],
        }
