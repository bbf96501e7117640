"""A quadrotor in space: attitude as a quaternion; thrust and body rates as commands.

safedpa check    quadrotor.py
safedpa up       --robot-file quadrotor.py --world payload=0.2
safedpa diagnose quadrotor.toml RUN/recording.mcap --robot-file quadrotor.py
"""

from __future__ import annotations

from math import cos, hypot
from pathlib import Path

import numpy as np

from safedpa.barrier_setting import BarrierSetting
from safedpa.drawing import Rings
from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, RateEffect, Stage, general_effects
from safedpa.robot import AbstractRobot
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.stand_in import AbstractStandIn
from safedpa.systems import System, Variable

GRAVITY = 9.81  # m/s2
STRONGEST = 20.0  # m/s2 of thrust
QUICKEST = 4.0  # rad/s about each axis
HIGHEST = 3.0  # m
STEEPEST = 0.7  # rad of tilt
AHEAD = 0.7  # s; heights are judged where it will be by then, which leaves the time to level and to brake

SYSTEM = System(
    name="quadrotor",
    state=(
        *(Variable(name, "m", -1e3, 1e3) for name in ("x", "y", "z")),
        *(Variable(name, "m/s", -30.0, 30.0) for name in ("vx", "vy", "vz")),
        *(Variable(name, "1", -1.1, 1.1) for name in ("qw", "qx", "qy", "qz")),
    ),
    action=(
        Variable("thrust", "m/s2", 0.0, STRONGEST),
        *(Variable(name, "rad/s", -QUICKEST, QUICKEST) for name in ("roll_rate", "pitch_rate", "yaw_rate")),
    ),
    rotations=(("qw", "qx", "qy", "qz"),),
)


def up_of(w, x, y, z):
    """The body's vertical axis in the world, for a quaternion from body to world."""
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)


class RigidQuadrotor(AbstractBase):
    """v' = thrust up - g, q' = q (0, rates) / 2: an inner loop follows the body rates."""

    kind = "rigid_quadrotor"
    equation = "p' = v, v' = thrust up(q) - (0, 0, gravity), q' = q (0, rates) / 2"
    source = "Mahony, Kumar, Corke, Multirotor Aerial Vehicles, IEEE RAM 19(3), 2012"
    system = SYSTEM
    parameters = (Parameter("gravity", "m/s2", 9.7, 9.9, GRAVITY, neutral=GRAVITY),)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        w, x, y, z = (state[name] for name in ("qw", "qx", "qy", "qz"))
        a, b, c = (0.5 * action[name] for name in ("roll_rate", "pitch_rate", "yaw_rate"))
        force = [action["thrust"] * axis for axis in up_of(w, x, y, z)]
        return {
            "x": state["vx"],
            "y": state["vy"],
            "z": state["vz"],
            "vx": force[0],
            "vy": force[1],
            "vz": force[2] - parameters["gravity"],
            "qw": -x * a - y * b - z * c,
            "qx": w * a + y * c - z * b,
            "qy": w * b + z * a - x * c,
            "qz": w * c + x * b - y * a,
        }


class RotorDrag(RateEffect):
    """v' -= side (v - (v . up) up) + vertical (v . up) up: blades flap, so drag is larger along the rotor plane."""

    name = "rotor_drag"
    robot = "quadrotor"
    family = "body_drag"
    stage = Stage.RESISTANCE
    equation = "v' -= side (v - (v . up) up) + vertical (v . up) up"
    parameters = (Parameter("side", "1/s", 0.0, 5.0, 0.3), Parameter("vertical", "1/s", 0.0, 5.0, 0.1))
    signature = "a residual against the motion in the plane of the rotors"
    source = "Faessler, Franchi, Scaramuzza, IEEE Robotics and Automation Letters 3(2), 2018"

    def modify(self, rates, parameters, context):
        """The rates with the drag, from those without it."""
        up = up_of(*(context.state[name] for name in ("qw", "qx", "qy", "qz")))
        v = [context.state[name] for name in ("vx", "vy", "vz")]
        climb = sum(one * axis for one, axis in zip(v, up, strict=True))
        along = (parameters["vertical"] - parameters["side"]) * climb
        lost = [parameters["side"] * one + along * axis for one, axis in zip(v, up, strict=True)]
        return {**rates, **{name: rates[name] - loss for name, loss in zip(("vx", "vy", "vz"), lost, strict=True)}}


class Payload(RateEffect):
    """(1 + mass_ratio) (v' + g) = that of the empty quadrotor."""

    name = "payload"
    robot = "quadrotor"
    stage = Stage.MASS
    equation = "(1 + mass_ratio) (v' + (0, 0, gravity)) = thrust up + forces"
    parameters = (Parameter("mass_ratio", "1", 0.0, 3.0, 0.2),)
    signature = "it sinks, and answers weaker in every direction, by one factor"
    source = "Newton, Principia, 1687"
    partners = ("rotor_drag",)

    def modify(self, rates, parameters, context):
        """The rates with the payload, from those without it."""
        total, gravity = 1.0 + parameters["mass_ratio"], context.base["gravity"]
        down = (rates["vz"] + gravity) / total - gravity
        return {**rates, "vx": rates["vx"] / total, "vy": rates["vy"] / total, "vz": down}


EFFECTS = general_effects(SYSTEM, moving={"vx": 2.0, "vy": 2.0, "vz": 1.5}, positions={})
STATES = SYSTEM.state_names


class Quadrotor(AbstractRobot):
    """What every program of safedpa asks of a quadrotor."""

    system = SYSTEM
    rate = 50.0
    can_stop = False  # thrust 0 is no rest: it falls
    model = Path(__file__).with_name("quadrotor.toml")
    kinds = ("height", "tilt")
    barrier_settings = (BarrierSetting("floor", "m", 0.5, "lowest height"),)
    measurement_deviation = (0.003, 0.003, 0.003, 0.02, 0.02, 0.02, 0.002, 0.002, 0.002, 0.002)

    def bases(self):
        """One kind of physics."""
        return {RigidQuadrotor.kind: RigidQuadrotor}

    def settings(self):
        """Bounds of the actions, and margins of a step."""
        low, high = [getattr(SYSTEM, f"action_{side}").tolist() for side in ("low", "high")]
        epsilon = {"height": 0.005, "tilt": 0.005}
        return FilterSettings(system="quadrotor", action_low=low, action_high=high, eta=0.1, epsilon=epsilon)

    def barriers(self, state, model, latent, settings):
        """h = height over the floor and below the top, some time ahead; the tilt left."""
        floor, steepest = settings.barrier("floor"), cos(STEEPEST)

        def heights(x):
            ahead = x[2] + AHEAD * x[5]
            return np.array([ahead - floor, HIGHEST - ahead])

        return (
            FunctionBarrier(heights, names=("floor", "top"), kind="height", reads=STATES),
            FunctionBarrier(lambda x: up_of(*x[6:])[2] - steepest, names=("tilt",), kind="tilt", reads=STATES),
        )

    def backup(self, state, model, settings):
        """Level, and to a stop."""
        return halted(np.asarray(state))

    def controllers(self, model):
        """One that flies to its goal at 1.5 m, or beyond what is allowed: the filter knows better."""
        return {"goal_seeker": Seeker}

    def draw(self, state):
        """Four rotors, from above."""
        x, y = state.values[:2]
        rotors = tuple((x + 0.18 * a, y + 0.18 * b) for a in (-1, 1) for b in (-1, 1))
        return {"rotors": Rings(rotors, (0.1,) * 4, 0x79C0FFFF, 0.012)}

    def stand_in(self, seed, given):
        """The simulated quadrotor; its world has a payload and rotor drag [1/s]."""
        return Flight(seed, **given)


def steered(state, wanted):
    """Thrust and rates (4,) that turn the thrust towards the wanted acceleration (3,) [m/s2] in 0.2 s."""
    w, x, y, z = state[6:]
    force, up = wanted + np.array([0.0, 0.0, GRAVITY]), np.array(up_of(w, x, y, z))
    columns = np.array([[1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], up])
    across = np.cross(up, columns[0])
    direction = force / max(float(np.linalg.norm(force)), 1e-9)
    rates = np.array([-across @ direction, columns[0] @ direction, 0.0]) / 0.2
    return np.array([float(np.clip(force @ up, 0.0, STRONGEST)), *np.clip(rates, -QUICKEST, QUICKEST)])


def halted(state):
    """Thrust and rates (4,) that level it, and bring its climb to a stop: the sooner, the less it still drifts."""
    vx, vy, vz = state[3:6]
    return steered(state, np.array([*np.clip([-0.5 * vx, -0.5 * vy], -2.0, 2.0), np.clip(-2.5 * vz, -6.0, 6.0)]))


class Seeker:
    """a = (1.5 (goal - p) clipped to 2 m/s - v) / 0.5 s."""

    def nominal_action(self, state, latent):
        """Thrust and rates (4,), and the controller's name."""
        now = np.array(state.values)
        wanted = 1.5 * (np.array([*state.goal[:2], 1.5]) - now[:3])
        wanted *= min(1.0, 2.0 / max(float(np.linalg.norm(wanted)), 1e-9))
        return tuple(steered(now, (wanted - now[3:6]) / 0.5).tolist()), "goal_seeker"


class Flight(AbstractStandIn):
    """The truth: a rotation matrix turned in small steps, rotor drag, and a payload that no model knows."""

    field = (-4.0, 4.0, -4.0, 4.0)

    def __init__(self, seed, payload=0.0, drag=0.0):
        self._random = np.random.default_rng(seed)
        self._payload, self._drag = payload, drag
        self._position, self._velocity, self._turned = np.array([0.0, 0.0, 1.5]), np.zeros(3), np.eye(3)
        self._goal = (2.0, 1.0)

    @property
    def values(self):
        """x, y, z, vx, vy, vz, qw, qx, qy, qz."""
        return (*self._position.tolist(), *self._velocity.tolist(), *quaternion_of(self._turned))

    @property
    def goal(self):
        """(2,) m."""
        return self._goal

    @property
    def obstacles(self):
        """None."""
        return ()

    def advance(self, action, seconds):
        """Small steps, each exact in the attitude for constant rates (Rodrigues)."""
        steps = 10
        dt = seconds / steps
        for _ in range(steps):
            up, v = self._turned[:, 2], self._velocity
            lost = self._drag * (v - 0.7 * (v @ up) * up)
            force = (action[0] * up - lost) / (1.0 + self._payload) - np.array([0.0, 0.0, GRAVITY])
            self._position = self._position + dt * v + 0.5 * dt * dt * force
            self._velocity = v + dt * force
            self._turned = self._turned @ rotated(np.array(action[1:]) * dt)
        if hypot(*(self._position[:2] - self._goal)) < 0.3:
            self.goals_reached += 1
            self._goal = tuple(self._random.uniform(-3.0, 3.0, 2).tolist())

    def contact(self):
        """The ground."""
        return "ground" if self._position[2] < 0.0 else ""

    def watchdog_action(self):
        """Level, and to a stop."""
        return tuple(halted(np.array(self.values)).tolist())


def rotated(turn):
    """The rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = turn / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def quaternion_of(matrix):
    """The unit quaternion (w, x, y, z) of a rotation matrix, with w >= 0."""
    outer = np.array(
        [
            [matrix.trace(), 0.0, 0.0, 0.0],
            [matrix[2, 1] - matrix[1, 2], 2 * matrix[0, 0] - matrix.trace(), 0.0, 0.0],
            [matrix[0, 2] - matrix[2, 0], matrix[0, 1] + matrix[1, 0], 2 * matrix[1, 1] - matrix.trace(), 0.0],
            [
                matrix[1, 0] - matrix[0, 1],
                matrix[0, 2] + matrix[2, 0],
                matrix[1, 2] + matrix[2, 1],
                2 * matrix[2, 2] - matrix.trace(),
            ],
        ]
    )
    # 4 q q' = this matrix + 1, of which only the lower half is read
    found = np.linalg.eigh(outer)[1][:, -1]
    return tuple((found * (1.0 if found[0] >= 0.0 else -1.0)).tolist())
