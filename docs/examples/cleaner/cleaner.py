"""A vacuum cleaner on two driven wheels: one folder, and all of safedpa works.

safedpa check    cleaner.py
safedpa up       --robot-file cleaner.py --world pull=0.3
safedpa diagnose plain.toml RUN/recording.mcap --robot-file cleaner.py
safedpa train    cleaner --robot-file cleaner.py --configuration learned.toml
"""

from __future__ import annotations

from math import atan2, cos, hypot, pi, sin
from pathlib import Path

import numpy as np

from safedpa.barrier_setting import BarrierSetting
from safedpa.drawing import Lines, Rings
from safedpa.dynamics import AbstractBase
from safedpa.effects import Parameter, RateEffect, Stage, general_effects
from safedpa.errors import InputError
from safedpa.networks.frame import Frame
from safedpa.robot import AbstractRobot
from safedpa.safety import FilterSettings, FunctionBarrier
from safedpa.stand_in import AbstractStandIn
from safedpa.systems import System, Variable

RADIUS = 0.18  # m
FASTEST, FASTEST_TURN = 0.8, 2.5  # m/s, rad/s

SYSTEM = System(
    name="cleaner",
    state=(
        Variable("x", "m", -1e3, 1e3),
        Variable("y", "m", -1e3, 1e3),
        Variable("yaw", "rad", -float("inf"), float("inf"), angle=True),
    ),
    action=(Variable("forward", "m/s", -2.0, 2.0), Variable("turn", "rad/s", -6.0, 6.0)),
)


class Wheels(AbstractBase):
    """x' = forward cos(yaw), y' = forward sin(yaw), yaw' = turn: no wheel slips."""

    kind = "wheels"
    equation = "x' = forward cos(yaw), y' = forward sin(yaw), yaw' = turn"
    source = "Siegwart, Nourbakhsh, Scaramuzza, Introduction to Autonomous Mobile Robots, 2nd ed., section 3.2"
    system = SYSTEM
    parameters = (Parameter("grip", "1", 0.1, 2.0, 1.0, neutral=1.0),)

    def rates(self, state, action, parameters, operations):
        """Rates of the state by name."""
        forward = parameters["grip"] * action["forward"]
        return {
            "x": forward * operations.cos(state["yaw"]),
            "y": forward * operations.sin(state["yaw"]),
            "yaw": action["turn"],
        }


class Pull(RateEffect):
    """yaw' += pull forward: one wheel is larger than the other, or its tyre softer."""

    name = "pull"
    robot = "cleaner"
    stage = Stage.MOTION
    equation = "d(yaw)/dt += pull forward"
    parameters = (Parameter("pull", "rad/m", -3.0, 3.0, 0.1),)
    signature = "it drives curves where a straight drive is commanded, the faster the more"
    source = "Borenstein, Feng, Measurement and Correction of Systematic Odometry Errors, IEEE T-RA 12(6), 1996"

    def modify(self, rates, parameters, context):
        """The rates with the pull, from those without it."""
        return {**rates, "yaw": rates["yaw"] + parameters["pull"] * context.action["forward"]}


EFFECTS = general_effects(SYSTEM)


class Cleaner(AbstractRobot):
    """What every program of safedpa asks of a robot on two wheels."""

    system = SYSTEM
    rate = 20.0
    model = Path(__file__).with_name("cleaner.toml")
    kinds = ("obstacle", "wall")
    barrier_settings = (BarrierSetting("clearance", "m", 0.05, "kept to obstacles and walls"),)
    measurement_deviation = (0.003, 0.003, 0.005)

    def bases(self):
        """One kind of physics."""
        return {Wheels.kind: Wheels}

    def settings(self):
        """Bounds of the actions; a margin of 1 cm a step, for what the motors' lag does."""
        return FilterSettings(
            system="cleaner",
            action_low=(-0.3, -FASTEST_TURN),
            action_high=(FASTEST, FASTEST_TURN),
            epsilon={"obstacle": 0.01, "wall": 0.01},
        )

    def barriers(self, state, model, latent, settings):
        """h = distance to an obstacle, or to a wall, less what the body and the clearance take."""
        reach = RADIUS + settings.barrier("clearance")
        found = []
        if state.obstacles:
            discs = np.array(state.obstacles)
            if discs.shape[1] != 3:
                raise InputError(f"obstacles: got rows of {discs.shape[1]}, wanted x, y, radius")
            names = tuple(f"obstacle {index}" for index in range(len(discs)))

            def free(x):
                return np.hypot(discs[:, 0] - x[0], discs[:, 1] - x[1]) - discs[:, 2] - reach

            found.append(FunctionBarrier(free, names=names, kind="obstacle", reads=SYSTEM.state_names))
        if state.field:
            low_x, high_x, low_y, high_y = state.field

            def inside(x):
                return np.array((x[0] - low_x, high_x - x[0], x[1] - low_y, high_y - x[1])) - reach

            walls = ("west wall", "east wall", "south wall", "north wall")
            found.append(FunctionBarrier(inside, names=walls, kind="wall", reads=SYSTEM.state_names))
        return found

    def controllers(self, model):
        """One that drives to its goal, past what is in the way."""
        return {"goal_seeker": Seeker}

    def frame(self):
        """Networks see the heading, and tell changes of place in the robot's own frame."""
        return Frame(("cos(yaw)", "sin(yaw)"), heading, heading, 2, ((0, 1),))

    def draw(self, state):
        """A disc with its two wheels."""
        x, y, yaw = state.values[:3]
        ahead, aside = np.array((cos(yaw), sin(yaw))), np.array((-sin(yaw), cos(yaw)))
        middle = np.array((x, y))
        wheels = [
            tuple(tuple((middle + 0.15 * side * aside + 0.06 * end * ahead).tolist()) for end in (-1, 1))
            for side in (-1, 1)
        ]
        nose = (tuple(middle.tolist()), tuple((middle + RADIUS * ahead).tolist()))
        return {
            "body": Rings(((x, y),), (RADIUS,), 0xE6EDF3FF, 0.012),
            "wheels": Lines((*wheels, nose), (0x8B949EFF, 0x8B949EFF, 0xE3B341FF), 0.03),
        }

    def stand_in(self, seed, given):
        """The simulated robot; its world has a ``pull`` [rad/m], a ``grip`` and a ``lag`` [s] of the motors."""
        return Drive(seed, **given)


def heading(state, operations):
    """Cosine and sine of the yaw."""
    return [operations.cos(state[2]), operations.sin(state[2])]


class Seeker:
    """forward = 0.8 m/s cos(e), turn = 2.5 e; e from the heading to the goal, or past the obstacle before it."""

    def nominal_action(self, state, latent):
        """The action (2,), and the controller's name."""
        x, y, yaw = state.values
        way = atan2(state.goal[1] - y, state.goal[0] - x)
        distance = hypot(state.goal[0] - x, state.goal[1] - y)
        for other_x, other_y, radius in state.obstacles:
            apart = hypot(other_x - x, other_y - y)
            towards, berth = atan2(other_y - y, other_x - x), radius + RADIUS + 0.15
            aside = (way - towards + pi) % (2 * pi) - pi
            needed = np.arcsin(min(1.0, berth / max(apart, 1e-9)))
            if apart < min(distance, 1.5) + radius and abs(aside) < needed:
                way = towards + (needed if aside >= 0.0 else -needed)
        error = (way - yaw + pi) % (2 * pi) - pi
        return (FASTEST * max(cos(error), 0.0), min(max(2.5 * error, -FASTEST_TURN), FASTEST_TURN)), "goal_seeker"


class Drive(AbstractStandIn):
    """The truth: motors with a lag, wheels of unlike size; goals among obstacles within walls."""

    field = (-3.0, 3.0, -3.0, 3.0)

    def __init__(self, seed, pull=0.0, grip=1.0, lag=0.03):
        self._random = np.random.default_rng(seed)
        self._pull, self._grip, self._lag = pull, grip, max(lag, 1e-3)
        places = [place for place in self._random.uniform(-2.2, 2.2, (40, 2)) if np.hypot(*place) > 0.9]
        self._obstacles = [(*place, float(self._random.uniform(0.15, 0.3))) for place in places[:6]]
        self._state, self._motors = np.zeros(3), np.zeros(2)
        self._goal = self._next_goal()

    @property
    def values(self):
        """x, y, yaw."""
        return tuple(self._state.tolist())

    @property
    def goal(self):
        """(2,) m."""
        return self._goal

    @property
    def obstacles(self):
        """x, y, radius of each."""
        return tuple(self._obstacles)

    def advance(self, action, seconds):
        """Small steps; the motors follow their command with a lag."""
        steps = 20
        for _ in range(steps):
            self._motors += (np.array(action) - self._motors) * min(1.0, seconds / steps / self._lag)
            forward, turn = self._grip * self._motors[0], self._motors[1] + self._pull * self._motors[0]
            yaw = self._state[2]
            self._state += np.array((forward * cos(yaw), forward * sin(yaw), turn)) * seconds / steps
        if hypot(*(self._state[:2] - self._goal)) < 0.2:
            self.goals_reached += 1
            self._goal = self._next_goal()

    def contact(self):
        """The obstacle or wall that it touches."""
        x, y = self._state[:2]
        for index, (other_x, other_y, radius) in enumerate(self._obstacles):
            if hypot(x - other_x, y - other_y) < radius + RADIUS:
                return f"obstacle {index}"
        return "wall" if max(abs(x), abs(y)) > 3.0 - RADIUS else ""

    def watchdog_action(self):
        """It stands."""
        return (0.0, 0.0)

    def _next_goal(self):
        while True:
            place = self._random.uniform(-2.5, 2.5, 2)
            if all(hypot(place[0] - x, place[1] - y) > radius + 0.5 for x, y, radius in self._obstacles):
                return tuple(place.tolist())
