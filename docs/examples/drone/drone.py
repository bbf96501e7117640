"""A drone that flies at one height among trees: one folder, and everything of safedpa works with it.

safedpa check    drone.py
safedpa up       --robot-file drone.py --world wind=1.5
safedpa diagnose drone.toml RUN/recording.mcap --robot-file drone.py
"""

from __future__ import annotations

from math import hypot
from pathlib import Path

import numpy as np

from safedpa.barrier_setting import BarrierSetting
from safedpa.drawing import Lines, Rings
from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, RateEffect, Stage, general_effects
from safedpa.errors import InputError
from safedpa.policy.grid_route import GridRoute
from safedpa.robot import AbstractRobot
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.safety.barriers.planar_body import BodyPart, PlanarBody
from safedpa.stand_in import AbstractStandIn
from safedpa.systems import System, Variable

RADIUS = 0.25  # m, from the middle to the tip of a rotor
STRONGEST = 4.0  # m/s2 along each axis
FASTEST = 3.0  # m/s
BRAKING = 2.0  # m/s2 against the motion that it can always reach, in any wind that it is made for

SYSTEM = System(
    name="drone",
    state=(
        Variable("x", "m", -1e3, 1e3),
        Variable("y", "m", -1e3, 1e3),
        Variable("vx", "m/s", -30.0, 30.0),
        Variable("vy", "m/s", -30.0, 30.0),
    ),
    action=(Variable("ax", "m/s2", -STRONGEST, STRONGEST), Variable("ay", "m/s2", -STRONGEST, STRONGEST)),
)


STATES = SYSTEM.state_names


class Hover(AbstractBase):
    """v' = a - drag v: a controller of attitude below turns the wanted acceleration into a tilt."""

    kind = "hover"
    equation = "x' = vx, y' = vy, vx' = ax - drag vx, vy' = ay - drag vy"
    source = "Mahony, Kumar, Corke, Multirotor Aerial Vehicles, IEEE RAM 19(3), 2012"
    system = SYSTEM
    parameters = (Parameter("drag", "1/s", 0.0, 5.0, 0.3),)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        drag = parameters["drag"]
        return {
            "x": state["vx"],
            "y": state["vy"],
            "vx": action["ax"] - drag * state["vx"],
            "vy": action["ay"] - drag * state["vy"],
        }


class Wind(RateEffect):
    """v' += (along, across): a steady wind."""

    name = "wind"
    robot = "drone"
    stage = Stage.MOTION
    equation = "d(vx)/dt += along, d(vy)/dt += across"
    parameters = (Parameter("along", "m/s2", -3.0, 3.0, 0.5), Parameter("across", "m/s2", -3.0, 3.0, 0.5))
    signature = "the same push everywhere, whatever it does"
    source = "Newton, Principia, 1687"

    def modify(self, rates, parameters, context):
        """The rates with the wind, from those without it."""
        return {**rates, "vx": rates["vx"] + parameters["along"], "vy": rates["vy"] + parameters["across"]}


EFFECTS = general_effects(SYSTEM, moving={"vx": 1.0, "vy": 1.0})


class Drone(AbstractRobot):
    """What every program of safedpa asks of a drone."""

    system = SYSTEM
    rate = 25.0
    model = Path(__file__).with_name("drone.toml")
    kinds = ("tree", "speed", "obstacle", "mover")
    barrier_settings = (BarrierSetting("clearance", "m", 0.05, "kept to trees"),)
    measurement_deviation = (0.005, 0.005, 0.02, 0.02)

    def bases(self):
        """One kind of physics."""
        return {Hover.kind: Hover}

    def settings(self):
        """Bounds of the actions, and a margin of 2 mm a step."""
        bound = (STRONGEST, STRONGEST)
        low = (-STRONGEST, -STRONGEST)
        return FilterSettings(
            system="drone", action_low=low, action_high=bound, eta=0.2,
            epsilon={"tree": 0.002, "speed": 0.01, "obstacle": 0.01, "mover": 0.05},
        )  # fmt: skip

    def planar_body(self, model, settings):
        """A disc without a heading, for barriers from sensors: its backup brakes at 2 m/s2, or 5 1/s."""
        return PlanarBody(
            BRAKING, 5.0, FASTEST, ("x", "y"), ("vx", "vy"), world=True, parts=(BodyPart(((0.0, 0.0),), RADIUS),),
            clearance=settings.barrier("clearance"), creeping=3.0,
        )  # fmt: skip

    def barriers(self, state, model, latent, settings):
        """h = distance to the tree - both radii - clearance - the way that it needs to stop towards it; a speed."""
        haste = FunctionBarrier(lambda x: FASTEST - hypot(x[2], x[3]), names=("haste",), kind="speed", reads=STATES)
        if not state.obstacles:
            return (haste,)
        trees = np.array(state.obstacles)
        if trees.shape[1] != 3:
            raise InputError(f"obstacles: got rows of {trees.shape[1]}, wanted x, y, radius")

        def h(x):
            apart = trees[:, :2] - x[:2]
            distance = np.hypot(apart[:, 0], apart[:, 1])
            towards = np.maximum((apart @ x[2:]) / np.maximum(distance, 1e-9), 0.0)
            return distance - trees[:, 2] - RADIUS - settings.barrier("clearance") - towards**2 / (2.0 * BRAKING)

        names = tuple(f"tree {index}" for index in range(len(trees)))
        return FunctionBarrier(h, names=names, kind="tree", reads=STATES), haste

    def backup(self, state, model, settings):
        """Against the motion, as strongly as it can."""
        speed = hypot(state[2], state[3])
        strength = min(STRONGEST, speed / 0.2)
        return -strength * state[2:] / max(speed, 1e-9)

    def controllers(self, model):
        """One that flies straight at its goal: the filter knows better."""
        return {"goal_seeker": Seeker}

    def draw(self, state):
        """A cross of rotors."""
        x, y = state.values[:2]
        arms = tuple(((x - 0.18, y - 0.18 * side), (x + 0.18, y + 0.18 * side)) for side in (1, -1))
        rotors = tuple(end for arm in arms for end in arm)
        return {
            "arms": Lines(arms, (0xE6EDF3FF,), 0.02),
            "rotors": Rings(rotors, (0.07,) * 4, 0x79C0FFFF, 0.012),
        }

    def stand_in(self, seed, given):
        """The simulated drone; its world has a wind along x and y [m/s2]."""
        return Flight(seed, **given)


class Seeker:
    """a = (2 (goal - p) clipped to 2 m/s - v) / 0.4 s - wind; with sensors, the goal is the next point of a route."""

    def __init__(self):
        self._route = GridRoute(RADIUS + 0.12)

    def look(self, seen):
        """The surroundings for the next state."""
        self._route.look(seen)

    def nominal_action(self, state, latent):
        """The acceleration (2,), and the controller's name."""
        position, velocity = np.array(state.values[:2]), np.array(state.values[2:])
        goal = self._route.aim(state.values[:2], state.goal, state.robot_time) if state.sources else state.goal
        wanted = 2.0 * (np.array(goal) - position)
        wanted *= min(1.0, 2.0 / max(float(np.hypot(*wanted)), 1e-9))
        wind = np.zeros(2) if latent is None else np.array(latent)
        return tuple(np.clip((wanted - velocity) / 0.4 - wind, -STRONGEST, STRONGEST).tolist()), "goal_seeker"


class Flight(AbstractStandIn):
    """The truth: drag 0.3 1/s, and a wind that no model knows; trees, and goals among them."""

    field = (-5.0, 5.0, -5.0, 5.0)

    def __init__(self, seed, wind=0.0, side_wind=0.0):
        self._random = np.random.default_rng(seed)
        self._wind = np.array([wind, side_wind])
        places = self._random.uniform(-4.0, 4.0, (40, 2))
        chosen = [place for place in places if np.hypot(*place) > 1.2]
        self._trees = [(*place, float(self._random.uniform(0.2, 0.4))) for place in chosen[:8]]
        self._state = np.zeros(4)
        self._goal = self._next_goal()

    @property
    def values(self):
        """x, y, vx, vy."""
        return tuple(self._state.tolist())

    @property
    def goal(self):
        """(2,) m."""
        return self._goal

    @property
    def obstacles(self):
        """x, y, radius of each tree."""
        return tuple(self._trees)

    def advance(self, action, seconds):
        """Small steps of v' = a + wind - 0.3 v."""
        steps = 10
        for _ in range(steps):
            force = np.array(action) + self._wind - 0.3 * self._state[2:]
            self._state[2:] += force * seconds / steps
            self._state[:2] += self._state[2:] * seconds / steps
        if hypot(*(self._state[:2] - self._goal)) < 0.3:
            self.goals_reached += 1
            self._goal = self._next_goal()

    def contact(self):
        """The tree that it touches."""
        for index, (x, y, radius) in enumerate(self._trees):
            if hypot(self._state[0] - x, self._state[1] - y) < radius + RADIUS:
                return f"tree {index}"
        return ""

    def watchdog_action(self):
        """Against the motion."""
        return tuple(np.clip(-3.0 * self._state[2:], -STRONGEST, STRONGEST).tolist())

    def _next_goal(self):
        while True:
            place = self._random.uniform(-4.0, 4.0, 2)
            if all(hypot(place[0] - x, place[1] - y) > radius + 0.7 for x, y, radius in self._trees):
                return tuple(place.tolist())
