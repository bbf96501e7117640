"""The true robots: equations of their own, integrated finely, with what is hidden added to them.

Nothing here comes from the product. Commands change between the rows of the log; the log has the command in force.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["PLANTS", "Hidden", "Plant", "Window", "drive", "predicted"]

Values = NDArray[np.float64]
Hidden = Mapping[str, Mapping[str, float]]
"""Parameters by effect: ``{action}_{kind}`` or ``{state}_{kind}``."""
Rates = Callable[[Values, Values], Values]

_STEPS: Final = 20
"""Steps of the integrator in a period."""
_RINGS: Final = 2.7
"""Radians by which a resonance turns within the shortest hold of a command."""


@dataclass(frozen=True)
class Plant:
    """One robot: names, sizes, the equations of motion, and how its logs are made."""

    states: tuple[str, ...]
    actions: tuple[str, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    """Bounds of the commands."""
    sizes: Mapping[str, float]
    """Usual size of what forces change."""
    noise: tuple[float, ...]
    """Standard deviations of the measured states."""
    rates: Rates
    period: float = 0.02
    seconds: float = 40.0
    hold: tuple[float, float] = (0.3, 1.5)
    """s; for how long a command is held."""
    start: tuple[float, ...] = ()
    position_of: Mapping[str, str] = field(default_factory=dict)
    """By rate: the position that it is the rate of."""
    control: Callable[[Values, Values], Values] | None = None
    """(state, level) -> command, for a robot that would run away with constant ones; four times in a period."""


def drive(plant: Plant, hidden: Hidden, seed: int, outside: str = "") -> tuple[Values, Values, Values]:
    """One log: times (n,), measured states (n, states) and commands (n, actions)."""
    times, states, commands, _ = _driven(plant, hidden, seed, outside, frozenset())
    return times, states, commands[::_STEPS]


Window = tuple[int, int, Values]
"""First and last row, and the state (states,) from which to predict."""


def predicted(plant: Plant, hidden: Hidden, seed: int, outside: str, windows: Sequence[Window]) -> Values:
    """The states (windows, states) at the last rows by the true equations, commands and internal states."""
    _, _, commands, robots = _driven(plant, hidden, seed, outside, frozenset(first for first, _, _ in windows))
    ends = []
    for first, last, start in windows:
        robot, x = copy.deepcopy(robots[first]), start
        for command in commands[first * _STEPS : last * _STEPS]:
            x = robot.step(x, command, plant.period / _STEPS)
        ends.append(x)
    return np.array(ends)


def _driven(
    plant: Plant, hidden: Hidden, seed: int, outside: str, kept: frozenset[int]
) -> tuple[Values, Values, Values, dict[int, _Robot]]:
    """Times, measured states, the commands of every step, and the robot as it was at the rows ``kept``."""
    random = np.random.default_rng(seed)
    rows = round(plant.seconds / plant.period)
    commands = _commands(plant, random, rows * _STEPS)
    robot, robots = _Robot(plant, hidden, outside), dict[int, _Robot]()
    x = np.array(plant.start or (0.0,) * len(plant.states))
    states, dt = np.empty((rows, len(x))), plant.period / _STEPS
    for step in range(rows * _STEPS):
        if plant.control is not None:
            fresh = plant.control(x, commands[step]) if step % (_STEPS // 4) == 0 else commands[step - 1]
            commands[step] = np.clip(fresh, plant.low, plant.high)
        if step % _STEPS == 0:
            states[step // _STEPS] = x
            if step // _STEPS in kept:
                robots[step // _STEPS] = copy.deepcopy(robot)
        x = robot.step(x, commands[step], dt)
    noisy = states + np.array(plant.noise) * random.standard_normal(states.shape)
    return np.array([plant.period * row for row in range(rows)]), noisy, commands, robots


class _Robot:
    """What happens to the commands, and the body that they move; all that a measured state does not show."""

    def __init__(self, plant: Plant, hidden: Hidden, outside: str) -> None:
        self._channels = [_Channel(plant, index, hidden, outside) for index in range(len(plant.actions))]
        self._body = _Body(plant, hidden, outside)

    def step(self, x: Values, commands: Values, dt: float) -> Values:
        """The state after ``dt``."""
        return self._body.step(x, np.array([channel.next(commands, dt) for channel in self._channels]), dt)


def _commands(plant: Plant, random: np.random.Generator, steps: int) -> Values:
    """Levels held for random times, a third of them around zero; changes fall between the rows."""
    dt, found = plant.period / _STEPS, np.empty((steps, len(plant.actions)))
    for index, (low, high) in enumerate(zip(plant.low, plant.high, strict=True)):
        at = 0
        while at < steps:
            end = at + max(1, round(float(random.uniform(*plant.hold)) / dt))
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            found[at:end, index] = middle + half * float(random.uniform(-1, 1)) * (
                0.4 if random.random() < 0.3 else 1.0
            )
            at = end
    return found


class _Channel:
    """What happens to one command before it acts: delay, then gain, offset, dead zone, limits, lag."""

    def __init__(self, plant: Plant, index: int, hidden: Hidden, outside: str) -> None:
        name = plant.actions[index]
        self._index, self._largest = index, max(abs(plant.low[index]), abs(plant.high[index]))
        self._own = {
            kind.removeprefix(f"{name}_"): values for kind, values in hidden.items() if kind.startswith(f"{name}_")
        }
        self._outside = outside if index == 0 else ""
        self._line: list[float] = []
        self._steps = 0
        self._value: float | None = None
        self._rate = 0.0
        self._heat = 0.0
        self._engaged = 0.0

    def _of(self, kind: str, name: str, otherwise: float) -> float:
        return self._own.get(kind, {}).get(name, otherwise)

    def next(self, commands: Values, dt: float) -> float:
        late = round(self._of("delay", "seconds", 0.0) / dt)
        self._line = [*self._line[-late:], float(commands[self._index])] if late else [float(commands[self._index])]
        self._steps += 1
        u = self._line[0]
        u = self._of("gain", "gain", 1.0) * u + self._of("offset", "offset", 0.0)
        if "dead_zone" in self._own:
            u = np.sign(u) * max(abs(u) - self._own["dead_zone"]["width"], 0.0)
        if "limit" in self._own:
            u = float(np.clip(u, -self._own["limit"]["limit"], self._own["limit"]["limit"]))
        u = self._strange(u, dt)
        if self._value is None:
            self._value = u
        if "slew_limit" in self._own:
            most = self._own["slew_limit"]["rate"] * dt
            self._value += float(np.clip(u - self._value, -most, most))
        elif "lag" in self._own:
            self._value += (u - self._value) * (1.0 - float(np.exp(-dt / self._own["lag"]["time_constant"])))
        elif "second_order" in self._own:
            w, z = self._own["second_order"]["frequency"], self._own["second_order"]["damping"]
            self._rate += dt * (w * w * (u - self._value) - 2.0 * z * w * self._rate)
            self._value += dt * self._rate
        else:
            self._value = u
        return float(self._value)

    def _strange(self, u: float, dt: float) -> float:
        """Effects that no library has, on the first command."""
        if self._outside == "quantised":
            step = 0.4 * self._largest
            return step * round(u / step)
        if self._outside == "heat":
            self._heat += dt * ((u / self._largest) ** 2 - self._heat / 6.0)
            return float(u / (1.0 + 0.6 * self._heat))
        if self._outside == "square_root":
            return float(np.sign(u) * self._largest * (abs(u) / self._largest) ** 0.5)
        if self._outside == "slipping_clutch":
            self._engaged += dt * (float(abs(u) > 0.5 * self._largest) - self._engaged) / 0.8
            return float(u * (1.0 - 0.5 * self._engaged))
        if self._outside == "missed_commands":
            period = 2.3
            return 0.0 if (self._steps * dt) % period < 0.25 * period else float(u)
        return u


class _Body:
    """The equations of motion with hidden forces; a Runge-Kutta step of order four."""

    def __init__(self, plant: Plant, hidden: Hidden, outside: str) -> None:
        self._plant, self._outside, self._time = plant, outside, 0.0
        self._forces = [
            (plant.states.index(name), name, kind.removeprefix(f"{name}_"), values)
            for kind, values in hidden.items()
            for name in plant.sizes
            if kind.startswith(f"{name}_")
        ]
        self._main = plant.states.index(next(iter(plant.sizes)))
        self._size = next(iter(plant.sizes.values()))
        self._hidden_mode = np.zeros(2)

    def step(self, x: Values, u: Values, dt: float) -> Values:
        one = self._rates(x, u)
        two = self._rates(x + 0.5 * dt * one, u)
        three = self._rates(x + 0.5 * dt * two, u)
        four = self._rates(x + dt * three, u)
        self._time += dt
        if self._outside == "resonance":
            # Only the command excites it: fed by the state too, it would make the fast robots unstable.
            pushed = (self._plant.rates(x, u) - self._plant.rates(x, np.zeros_like(u)))[self._main]
            mode, frequency = self._hidden_mode, _RINGS / self._plant.hold[0]
            mode[1] += dt * frequency * (frequency * (0.5 * pushed - mode[0]) - 0.09 * mode[1])
            mode[0] += dt * mode[1]
        following = x + dt / 6.0 * (one + 2.0 * two + 2.0 * three + four)
        for index, _, kind, values in self._forces:
            if kind == "speed_limit":
                following[index] = float(np.clip(following[index], -values["limit"], values["limit"]))
            elif kind == "friction":
                # Dry friction stops at standstill and holds there; rounded off near rest it would be a viscous creep.
                stop = values["deceleration"] * dt
                following[index] -= float(np.clip(following[index], -stop, stop))
        return following

    def _rates(self, x: Values, u: Values) -> Values:
        rates = self._plant.rates(x, u)
        for index, name, kind, values in self._forces:
            rates[index] = self._with(kind, values, name, x, rates[index])
        v, size = x[self._main], self._size
        if self._outside == "periodic":
            rates[self._main] += 0.5 * size * np.sin(2.0 * np.pi * self._time / 3.7)
        elif self._outside == "drag_by_action":
            rates[self._main] -= 1.2 * v * abs(u[0]) / max(abs(self._plant.low[0]), abs(self._plant.high[0]))
        elif self._outside == "band":
            rates[self._main] *= 0.5 if 0.25 * size < abs(v) < 0.8 * size else 1.0
        elif self._outside == "resonance":
            # The rate of the mode, which vanishes under a constant command: no gain makes up for it.
            rates[self._main] += self._hidden_mode[1] * self._plant.hold[0] / _RINGS
        elif self._outside == "bumps":
            rates[self._main] += 0.6 * size * float(np.sin(11.0 * v / size))
        return rates

    def _with(self, kind: str, values: Mapping[str, float], name: str, x: Values, rate: float) -> float:
        """The rate of the state ``name`` with one hidden effect, from the rate without it."""
        v, states = x[self._plant.states.index(name)], self._plant.states
        position = x[states.index(self._plant.position_of[name])] if name in self._plant.position_of else 0.0
        (number,) = values.values()
        changed = {
            "drag": rate - number * v,
            "quadratic_drag": rate - number * abs(v) * v,
            "friction": rate,  # after the step
            "push": rate + number,
            "acceleration_limit": float(np.clip(rate, -number, number)),
            "gravity": rate - number * float(np.sin(position)),
            "spring": rate - number * position,
            "speed_limit": 0.0 if abs(v) >= number and rate * v > 0.0 else rate,
        }
        return float(changed[kind])


def _servo(x: Values, u: Values) -> Values:
    return np.array([x[1], 210.0 * (u[0] - x[0]) - 22.0 * x[1]])


def _joint(x: Values, u: Values) -> Values:
    return np.array([x[1], 2.1 * u[0] - 6.2 * np.sin(x[0])])


def _hold_joint(x: Values, level: Values) -> Values:
    return np.array([2.0 * (0.4 * level[0] - x[0]) - 0.5 * x[1] + 2.0 * np.sin(x[0])])


def _hold_crane(x: Values, level: Values) -> Values:
    return np.array([1.5 * level[0] - 0.8 * x[0] - 0.8 * x[1]])


def _tank(x: Values, u: Values) -> Values:
    return np.array([0.0042 * u[0] - 0.021 * np.sqrt(max(x[0], 0.0))])


def _boat(x: Values, u: Values) -> Values:
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array([x[3] * c, x[3] * s, x[4], 1.2 * u[0] - 0.4 * x[3], 0.9 * u[1] * x[3] - 1.2 * x[4]])


def _omni(x: Values, u: Values) -> Values:
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array([c * x[3] - s * x[4], s * x[3] + c * x[4], x[5], *((u - x[3:]) / 0.25)])


def _crane(x: Values, u: Values) -> Values:
    c, s = np.cos(x[2]), np.sin(x[2])
    # The same physics by solving the two coupled equations for both accelerations.
    mass = np.array([[1.3, 0.3 * 0.5 * c], [c, 0.5]])
    force = np.array([u[0] + 0.3 * 0.5 * x[3] ** 2 * s, -9.81 * s])
    along, turning = np.linalg.solve(mass, force)
    return np.array([x[1], along, x[3], turning])


def _motor(x: Values, u: Values) -> Values:
    return np.array([52.0 * u[0] - 5.0 * x[0]])


def _quadrotor(x: Values, u: Values) -> Values:
    pitch, roll = u[1], u[2]
    return np.array(
        [u[0] * np.sin(pitch) * np.cos(roll), -u[0] * np.sin(roll), u[0] * np.cos(pitch) * np.cos(roll) - 9.81]
    )


def _bicycle(x: Values, u: Values) -> Values:
    along = max(x[3], 1.0)
    front, rear = 30.0 * (u[1] - (x[4] + 0.15 * x[5]) / along), -30.0 * (x[4] - 0.15 * x[5]) / along
    c, s = np.cos(x[2]), np.sin(x[2])
    return np.array(
        [
            c * x[3] - s * x[4],
            s * x[3] + c * x[4],
            x[5],
            1.5 * (u[0] - x[3]),
            front + rear - x[5] * x[3],
            (front - rear) / 0.15,
        ]
    )


def _conveyor(x: Values, u: Values) -> Values:
    return np.array([2.1 * (u[0] - x[0])])


PLANTS: Final[dict[str, Plant]] = {
    "own_servo": Plant(
        ("angle", "rate"), ("target",), (-0.9,), (0.9,), {"rate": 2.0}, (0.002, 0.03), _servo,
        position_of={"rate": "angle"},
    ),
    "own_joint": Plant(
        ("position", "rate"), ("current",), (-4.0,), (4.0,), {"rate": 2.0}, (0.001, 0.01), _joint,
        position_of={"rate": "position"}, control=_hold_joint,
    ),
    "own_tank": Plant(
        ("level",), ("pump",), (1.0,), (9.0,), {"level": 1.0}, (0.004,), _tank, 1.0, 3000.0, (20.0, 200.0), (1.0,)
    ),
    "own_boat": Plant(
        ("x", "y", "yaw", "surge", "turn"), ("thrust", "rudder"), (-0.3, -0.5), (1.0, 0.5), {"surge": 2.0, "turn": 0.5},
        (0.02, 0.02, 0.005, 0.02, 0.01), _boat, 0.1, 150.0, (1.0, 8.0),
    ),
    "own_omni": Plant(
        ("x", "y", "yaw", "vx", "vy", "w"), ("ux", "uy", "uw"), (-0.9, -0.9, -1.8), (0.9, 0.9, 1.8),
        {"vx": 0.7, "vy": 0.7, "w": 1.5}, (0.003, 0.003, 0.004, 0.01, 0.01, 0.02), _omni, 0.05, 60.0, (0.4, 2.0),
    ),
    "own_crane": Plant(
        ("x", "v", "angle", "rate"), ("force",), (-4.0,), (4.0,), {"v": 1.0, "rate": 2.0}, (0.002, 0.01, 0.002, 0.02),
        _crane, position_of={"rate": "angle"}, seconds=30.0, hold=(0.3, 1.2), control=_hold_crane,
    ),
    "own_motor": Plant(
        ("speed",), ("voltage",), (-11.0,), (11.0,), {"speed": 60.0}, (0.5,), _motor, 0.01, 20.0, (0.1, 0.8)
    ),
    "own_quadrotor": Plant(
        ("vx", "vy", "vz"), ("thrust", "pitch", "roll"), (8.8, -0.2, -0.2), (10.8, 0.2, 0.2),
        {"vx": 2.0, "vy": 2.0, "vz": 1.5}, (0.02, 0.02, 0.02), _quadrotor, 0.02, 40.0, (0.2, 1.0),
    ),
    "own_bicycle": Plant(
        ("x", "y", "yaw", "vx", "vy", "r"), ("speed", "steer"), (1.5, -0.3), (5.0, 0.3), {"vx": 3.0, "r": 1.0},
        (0.01, 0.01, 0.004, 0.02, 0.02, 0.02), _bicycle, 0.02, 60.0, (0.5, 3.0), (0.0, 0.0, 0.0, 2.0, 0.0, 0.0),
    ),
    "own_conveyor": Plant(
        ("speed",), ("target",), (-1.8,), (1.8,), {"speed": 1.0}, (0.01,), _conveyor, 0.05, 60.0, (0.5, 3.0)
    ),
}  # fmt: skip
"""By name of the model's system; parameters of the base are up to 5 % off those of the model."""

OUTSIDE: Final[Sequence[str]] = (
    *("quantised", "heat", "square_root", "slipping_clutch", "missed_commands"),
    *("periodic", "drag_by_action", "band", "resonance", "bumps"),
)
"""Ten effects that no library has."""
