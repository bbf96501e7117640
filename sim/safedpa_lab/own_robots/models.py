"""Ten robots as a user declares them: system, known physics, and what may be missing from ``general_effects``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, general_effects
from safedpa.systems import System, Variable

Named = Mapping[str, Any]


def _number(name: str, unit: str, low: float, high: float, usual: float) -> Parameter:
    return Parameter(name, unit, low, high, usual, neutral=None)


POSITION_LOOP = System(
    name="own_servo",
    state=(Variable("angle", "rad", -3.0, 3.0), Variable("rate", "rad/s", -30.0, 30.0)),
    action=(Variable("target", "rad", -1.0, 1.0),),
)


class PositionLoop(AbstractBase):
    """d(rate)/dt = stiffness (target - angle) - damping rate: an RC servo."""

    kind = "own_position_loop"
    equation = "rate' = stiffness (target - angle) - damping rate"
    source = "data sheet"
    system = POSITION_LOOP
    parameters = (_number("stiffness", "1/s2", 1.0, 5000.0, 200.0), _number("damping", "1/s", 0.0, 500.0, 20.0))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        pull = parameters["stiffness"] * (action["target"] - state["angle"])
        return {"angle": state["rate"], "rate": pull - parameters["damping"] * state["rate"]}


JOINT_WITH_GRAVITY = System(
    name="own_joint",
    state=(Variable("position", "rad", -20.0, 20.0), Variable("rate", "rad/s", -20.0, 20.0)),
    action=(Variable("current", "A", -10.0, 10.0),),
)


class JointWithGravity(AbstractBase):
    """d(rate)/dt = gain current - gravity sin(position): one joint of an arm."""

    kind = "own_joint"
    equation = "rate' = gain current - gravity sin(position)"
    source = "Newton"
    system = JOINT_WITH_GRAVITY
    parameters = (_number("gain", "rad/s2/A", 0.01, 100.0, 2.0), _number("gravity", "rad/s2", 0.0, 100.0, 6.0))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        weight = parameters["gravity"] * operations.sin(state["position"])
        return {"position": state["rate"], "rate": parameters["gain"] * action["current"] - weight}


TANK = System(
    name="own_tank",
    state=(Variable("level", "m", 0.0, 4.0),),
    action=(Variable("pump", "V", 0.0, 10.0),),
)


class Tank(AbstractBase):
    """d(level)/dt = inflow pump - outflow sqrt(level): a tank with a pump and a hole."""

    kind = "own_tank"
    equation = "level' = inflow pump - outflow sqrt(level)"
    source = "Torricelli, 1643"
    system = TANK
    parameters = (_number("inflow", "m/s/V", 0.0, 1.0, 0.004), _number("outflow", "m^0.5/s", 0.0, 1.0, 0.02))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        out = parameters["outflow"] * operations.sqrt(operations.maximum(state["level"], 1e-6))
        return {"level": parameters["inflow"] * action["pump"] - out}


BOAT = System(
    name="own_boat",
    state=(
        Variable("x", "m", -1e4, 1e4), Variable("y", "m", -1e4, 1e4), Variable("yaw", "rad", -1e3, 1e3),
        Variable("surge", "m/s", -5.0, 8.0), Variable("turn", "rad/s", -3.0, 3.0),
    ),
    action=(Variable("thrust", "1", -1.0, 1.0), Variable("rudder", "rad", -0.6, 0.6)),
)  # fmt: skip


class Boat(AbstractBase):
    """A boat that surges by its thrust and turns by its rudder, with known linear drag."""

    kind = "own_boat"
    equation = "surge' = thrust_gain thrust - surge_damping surge; turn' = rudder_gain rudder surge - turn_damping turn"
    source = "Fossen, Handbook of Marine Craft, 2nd ed., ch. 6"
    system = BOAT
    parameters = (
        _number("thrust_gain", "m/s2", 0.01, 20.0, 1.2), _number("surge_damping", "1/s", 0.0, 10.0, 0.4),
        _number("rudder_gain", "1/m/s", 0.01, 20.0, 0.9), _number("turn_damping", "1/s", 0.0, 20.0, 1.2),
    )  # fmt: skip

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        p, surge, turn = parameters, state["surge"], state["turn"]
        return {
            "x": surge * operations.cos(state["yaw"]),
            "y": surge * operations.sin(state["yaw"]),
            "yaw": turn,
            "surge": p["thrust_gain"] * action["thrust"] - p["surge_damping"] * surge,
            "turn": p["rudder_gain"] * action["rudder"] * surge - p["turn_damping"] * turn,
        }


OMNIDIRECTIONAL_BASE = System(
    name="own_omni",
    state=(
        Variable("x", "m", -1e3, 1e3), Variable("y", "m", -1e3, 1e3), Variable("yaw", "rad", -1e3, 1e3),
        Variable("vx", "m/s", -4.0, 4.0), Variable("vy", "m/s", -4.0, 4.0), Variable("w", "rad/s", -6.0, 6.0),
    ),
    action=(
        Variable("ux", "m/s", -1.0, 1.0), Variable("uy", "m/s", -1.0, 1.0), Variable("uw", "rad/s", -2.0, 2.0),
    ),
)  # fmt: skip


class OmnidirectionalBase(AbstractBase):
    """Three velocities in the body's frame that follow their targets."""

    kind = "own_omni"
    equation = "v' = (target - v) / time_constant, for vx, vy and w"
    source = "data sheet"
    system = OMNIDIRECTIONAL_BASE
    parameters = (_number("time_constant", "s", 0.01, 5.0, 0.25),)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        cos, sin, constant = operations.cos(state["yaw"]), operations.sin(state["yaw"]), parameters["time_constant"]
        return {
            "x": cos * state["vx"] - sin * state["vy"],
            "y": sin * state["vx"] + cos * state["vy"],
            "yaw": state["w"],
            "vx": (action["ux"] - state["vx"]) / constant,
            "vy": (action["uy"] - state["vy"]) / constant,
            "w": (action["uw"] - state["w"]) / constant,
        }


CRANE = System(
    name="own_crane",
    state=(
        Variable("x", "m", -50.0, 50.0), Variable("v", "m/s", -10.0, 10.0),
        Variable("angle", "rad", -6.0, 6.0), Variable("rate", "rad/s", -30.0, 30.0),
    ),
    action=(Variable("force", "N", -10.0, 10.0),),
)  # fmt: skip


class Crane(AbstractBase):
    """A cart with a hanging pole: mass M, m at length l, without friction."""

    kind = "own_crane"
    equation = "Lagrange's equations of cart and pole"
    source = "Florian, Correct equations for the dynamics of the cart-pole system, 2007"
    system = CRANE
    parameters = (
        _number("cart", "kg", 0.01, 50.0, 1.0), _number("pole", "kg", 0.001, 50.0, 0.3),
        _number("length", "m", 0.01, 10.0, 0.5),
    )  # fmt: skip

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name; the angle is 0 where the pole hangs."""
        m, length, rate = parameters["pole"], parameters["length"], state["rate"]
        cos, sin = operations.cos(state["angle"]), operations.sin(state["angle"])
        total = parameters["cart"] + m * sin * sin
        acceleration = (action["force"] + m * sin * (length * rate * rate + 9.81 * cos)) / total
        return {
            "x": state["v"],
            "v": acceleration,
            "angle": rate,
            "rate": -(acceleration * cos + 9.81 * sin) / length,
        }


MOTOR = System(
    name="own_motor",
    state=(Variable("speed", "rad/s", -300.0, 300.0),),
    action=(Variable("voltage", "V", -12.0, 12.0),),
)


class Motor(AbstractBase):
    """d(speed)/dt = gain voltage - damping speed: a DC motor."""

    kind = "own_motor"
    equation = "speed' = gain voltage - damping speed"
    source = "data sheet"
    system = MOTOR
    parameters = (_number("gain", "rad/s2/V", 0.1, 1000.0, 50.0), _number("damping", "1/s", 0.0, 100.0, 5.0))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        return {"speed": parameters["gain"] * action["voltage"] - parameters["damping"] * state["speed"]}


QUADROTOR = System(
    name="own_quadrotor",
    state=(Variable("vx", "m/s", -20.0, 20.0), Variable("vy", "m/s", -20.0, 20.0), Variable("vz", "m/s", -20.0, 20.0)),
    action=(
        Variable("thrust", "m/s2", 0.0, 20.0), Variable("pitch", "rad", -0.5, 0.5), Variable("roll", "rad", -0.5, 0.5),
    ),
)  # fmt: skip


class Quadrotor(AbstractBase):
    """Velocities of a quadrotor whose attitude follows at once: thrust, pitch and roll in, no drag."""

    kind = "own_quadrotor"
    equation = "v' = thrust R(roll, pitch) e_z - g e_z"
    source = "Mahony, Kumar, Corke, Multirotor Aerial Vehicles, 2012"
    system = QUADROTOR
    parameters = (_number("gravity", "m/s2", 9.7, 9.9, 9.81),)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        thrust, cos, sin = action["thrust"], operations.cos, operations.sin
        return {
            "vx": thrust * sin(action["pitch"]) * cos(action["roll"]),
            "vy": -thrust * sin(action["roll"]),
            "vz": thrust * cos(action["pitch"]) * cos(action["roll"]) - parameters["gravity"],
        }


BICYCLE_WITH_SLIP = System(
    name="own_bicycle",
    state=(
        Variable("x", "m", -1e4, 1e4), Variable("y", "m", -1e4, 1e4), Variable("yaw", "rad", -1e3, 1e3),
        Variable("vx", "m/s", 0.0, 20.0), Variable("vy", "m/s", -5.0, 5.0), Variable("r", "rad/s", -6.0, 6.0),
    ),
    action=(Variable("speed", "m/s", 0.0, 6.0), Variable("steer", "rad", -0.4, 0.4)),
)  # fmt: skip


class BicycleWithSlip(AbstractBase):
    """A dynamic bicycle with linear tyres, whose speed follows its target."""

    kind = "own_bicycle"
    equation = "m (vy' + r vx) = Ff + Fr; I r' = lf Ff - lr Fr; F = stiffness slip"
    source = "Rajamani, Vehicle Dynamics and Control, 2nd ed., ch. 2"
    system = BICYCLE_WITH_SLIP
    parameters = (_number("follow", "1/s", 0.05, 20.0, 1.5), _number("stiffness", "m/s2/rad", 1.0, 1000.0, 30.0))

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name; ``stiffness`` is per mass and radian, both axles 0.15 m from the centre."""
        vx, vy, r, arm = state["vx"], state["vy"], state["r"], 0.15
        along = operations.maximum(vx, 1.0)
        front = parameters["stiffness"] * (action["steer"] - (vy + arm * r) / along)
        rear = -parameters["stiffness"] * (vy - arm * r) / along
        cos, sin = operations.cos(state["yaw"]), operations.sin(state["yaw"])
        return {
            "x": cos * vx - sin * vy,
            "y": sin * vx + cos * vy,
            "yaw": r,
            "vx": parameters["follow"] * (action["speed"] - vx),
            "vy": front + rear - r * vx,
            "r": (front - rear) / arm,
        }


CONVEYOR = System(
    name="own_conveyor",
    state=(Variable("speed", "m/s", -5.0, 5.0),),
    action=(Variable("target", "m/s", -2.0, 2.0),),
)


class Conveyor(AbstractBase):
    """d(speed)/dt = gain (target - speed): a belt with its drive."""

    kind = "own_conveyor"
    equation = "speed' = gain (target - speed)"
    source = "data sheet"
    system = CONVEYOR
    parameters = (_number("gain", "1/s", 0.01, 50.0, 2.0),)

    def rates(self, state: Named, action: Named, parameters: Named, operations: Any) -> dict[str, Any]:
        """Rates of the state by name."""
        return {"speed": parameters["gain"] * (action["target"] - state["speed"])}


BASES = (
    PositionLoop,
    JointWithGravity,
    Tank,
    Boat,
    OmnidirectionalBase,
    Crane,
    Motor,
    Quadrotor,
    BicycleWithSlip,
    Conveyor,
)
MOVING = {
    "own_servo": {"rate": 2.0}, "own_joint": {"rate": 2.0}, "own_tank": {"level": 1.0},
    "own_boat": {"surge": 2.0, "turn": 0.5}, "own_omni": {"vx": 0.7, "vy": 0.7, "w": 1.5},
    "own_crane": {"v": 1.0, "rate": 2.0}, "own_motor": {"speed": 60.0},
    "own_quadrotor": {"vx": 2.0, "vy": 2.0, "vz": 1.5}, "own_bicycle": {"vx": 3.0, "r": 1.0},
    "own_conveyor": {"speed": 1.0},
}  # fmt: skip
"""Usual size of what forces change, by robot."""
EFFECTS = tuple(item for base in BASES for item in general_effects(base.system, moving=MOVING[base.system.name]))
