"""Sixteen faults of a log's data, and good logs of the same robots that look alike but have none.

A fault changes what was recorded, never the robot: physics that a diagnosis finds in such a log is wrong. Good logs
hold effects, ordered stops, end stops and an overflowing tank.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from safedpa_lab.own_robots.cases import STRENGTHS
from safedpa_lab.own_robots.plants import OUTSIDE, PLANTS, Hidden, Plant, Values, drive

__all__ = ["FAULTS", "GOOD", "Fault", "Log", "Truth", "faulty_log", "good_log"]

_DRIFT: Final = 0.25
"""s by which a clock is late at the end of a log, or four rows if those last longer."""
_FROZEN: Final = 6.0
"""s, or 120 rows if those last longer."""
_STALE_SHARE: Final = 0.4
_OFFSET, _STEP = 0.12, 0.05
"""Of a recalibration and of a quantisation, as a share of the range of a state."""
_LOST: Final = 0.2
"""Share of dropped rows."""


@dataclass
class Log:
    """Times (rows,), states (rows, states) and actions (rows, actions)."""

    t: Values
    states: Values
    actions: Values


@dataclass(frozen=True)
class Truth:
    """What a finding must name: one of the channels, the time, and the size."""

    channels: tuple[str, ...]
    time: float | None
    """Of the first spoilt row [s]; None: the whole log is spoilt."""
    size: float
    """Factor, offset, seconds or share; NaN where there is none."""


Spoil = Callable[[Plant, Log, np.random.Generator], Truth]


@dataclass(frozen=True)
class Fault:
    """One way in which a log is wrong."""

    name: str
    meaning: str
    spoil: Spoil


def faulty_log(fault: Fault, robot: str, seed: int) -> tuple[Log, Truth]:
    """A log of an undisturbed robot with one fault, and what must be found."""
    log = good_log("plain", robot, seed)
    return log, fault.spoil(PLANTS[robot], log, np.random.default_rng([seed, 11]))


def _positions(plant: Plant) -> list[int]:
    """Indices of the states that forces do not change directly; of a robot without them the first state."""
    return [index for index, name in enumerate(plant.states) if name not in plant.sizes] or [0]


def _row(log: Log, random: np.random.Generator) -> int:
    return round(float(random.uniform(0.4, 0.6)) * len(log.t))


def _spread(values: Values) -> float:
    low, high = np.quantile(values, (0.01, 0.99))
    return float(high - low)


def _scaled_action(index: int, factor: float, part: str) -> Spoil:
    """Multiplies an action from halfway or late in the log on, or in the ``whole``."""

    def spoil(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
        row = _row(log, random) + (len(log.t) // 5 if part == "late" else 0)
        rows = slice(None) if part == "whole" else slice(row, None)
        log.actions[rows, index] *= factor
        return Truth((plant.actions[index],), None if part == "whole" else float(log.t[row]), factor)

    return spoil


def _late_states(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    late = max(_DRIFT, 4.0 * plant.period) * float(random.uniform(0.9, 1.1))
    delays = late * (log.t - log.t[0]) / (log.t[-1] - log.t[0])
    for index in _positions(plant):
        log.states[:, index] = np.interp(log.t - delays, log.t, log.states[:, index])
    return Truth(tuple(plant.states[index] for index in _positions(plant)), None, late)


def _late_commands(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    late = max(_DRIFT, 4.0 * plant.period) * float(random.uniform(0.9, 1.1))
    rows = np.round(late / plant.period * np.linspace(0.0, 1.0, len(log.t))).astype(np.intp)
    log.actions[:] = log.actions[np.maximum(np.arange(len(log.t)) - rows, 0)]
    return Truth(plant.actions, None, late)


def _recalibrated(index: int) -> Spoil:
    def spoil(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
        at, row = (_positions(plant)[0] if index == 0 else index), _row(log, random)
        offset = _OFFSET * _spread(log.states[:, at]) * float(random.choice([-1.0, 1.0]))
        log.states[row:, at] += offset
        return Truth((plant.states[at],), float(log.t[row]), offset)

    return spoil


def _stale_commands(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    """In spans that hold 40 % of the rows all commands are those of the first row of the span."""
    held, row, first = plant.hold[0] / plant.period, 0, -1
    while row < len(log.t):
        stale = round(held * float(random.uniform(0.5, 1.5)))
        row += round(stale * (1.0 - _STALE_SHARE) / _STALE_SHARE)
        changed = row + np.flatnonzero(np.any(log.actions[row : row + stale] != log.actions[row : row + 1], axis=1))
        first = int(changed[0]) if first < 0 and len(changed) else first
        log.actions[row : row + stale] = log.actions[row : row + 1]
        row += stale
    return Truth(plant.actions, float(log.t[first]), _STALE_SHARE)


def _quantised(index: int, *, halfway: bool) -> Spoil:
    def spoil(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
        at, row = (_positions(plant)[0] if index == 0 else index), _row(log, random) if halfway else 0
        step = _STEP * _spread(log.states[:, at])
        log.states[row:, at] = step * np.round(log.states[row:, at] / step)
        return Truth((plant.states[at],), float(log.t[row]) if halfway else None, step)

    return spoil


def _frozen_pose(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    row, seconds = _row(log, random), max(_FROZEN, 120.0 * plant.period)
    for index in _positions(plant):
        log.states[row : row + round(seconds / plant.period), index] = log.states[row, index]
    return Truth(tuple(plant.states[index] for index in _positions(plant)), float(log.t[row]), seconds)


def _dropped(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    retained = random.random(len(log.t)) > _LOST
    first = int(np.flatnonzero(~retained[1:])[0])
    log.t, log.states, log.actions = log.t[retained], log.states[retained], log.actions[retained]
    return Truth(("gap", "gaps", "sampling"), float(plant.period * first), float("nan"))


_ANGLES: Final = {"angle", "position", "yaw"}
_ANGLES_COMMANDED: Final = {"target", "rudder", "pitch", "steer"}


def _degrees_of_states(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    """The first angle, or the first state of a robot without angles, in degrees."""
    at = next((index for index, name in enumerate(plant.states) if name in _ANGLES), 0)
    log.states[:, at] = np.degrees(log.states[:, at])
    return Truth((plant.states[at],), None, float(np.degrees(1.0)))


def _degrees_of_commands(plant: Plant, log: Log, random: np.random.Generator) -> Truth:
    """A commanded angle, or the last command of a robot without, in degrees."""
    at = next((k for k, name in enumerate(plant.actions) if name in _ANGLES_COMMANDED), len(plant.actions) - 1)
    log.actions[:, at] = np.degrees(log.actions[:, at])
    return Truth((plant.actions[at],), None, float(np.degrees(1.0)))


FAULTS: Final[Mapping[str, Fault]] = {
    name: Fault(name, meaning, spoil)
    for name, meaning, spoil in (
        ("command_reversed", "sign of the first command, from halfway", _scaled_action(0, -1.0, "halfway")),
        ("other_command_reversed", "sign of the last command, from late on", _scaled_action(-1, -1.0, "late")),
        ("wheel_reversed", "sign of the last command, throughout", _scaled_action(-1, -1.0, "whole")),
        ("states_drift", "the clock of the pose loses 0.25 s", _late_states),
        ("commands_drift", "the clock of the commands loses 0.25 s", _late_commands),
        ("actuator_reads_zero", "the first command reads 0, from halfway", _scaled_action(0, 0.0, "halfway")),
        ("recalibrated", "offset of the first position, from halfway", _recalibrated(0)),
        ("rate_recalibrated", "offset of the last state, from halfway", _recalibrated(-1)),
        ("stale_commands", "commands are old in 40 % of the rows", _stale_commands),
        ("quantised", "the first position in steps, from halfway", _quantised(0, halfway=True)),
        ("rate_quantised", "the last state in steps, throughout", _quantised(-1, halfway=False)),
        ("pose_frozen", "all positions stay for 6 s", _frozen_pose),
        ("packets_dropped", "a fifth of the rows is missing", _dropped),
        ("degrees", "an angle in degrees", _degrees_of_states),
        ("command_in_degrees", "a commanded angle in degrees", _degrees_of_commands),
        ("milli", "the first command in thousandths", _scaled_action(0, 1000.0, "whole")),
    )
}
"""Each once: some occur on two channels."""

GOOD: Final = ("plain", "effect", "outside", "ordered_stop", "end_stop")
"""Logs without a fault: as the robot is, with a hidden effect, with one of no library, braked, at an end stop."""


def good_log(kind: str, robot: str, seed: int) -> Log:
    """A log without a fault. An end stop of a robot that has none is a plain log."""
    plant, random = PLANTS[robot], np.random.default_rng([seed, 12])
    hidden: Hidden = {}
    outside = ""
    if kind == "effect":
        name = str(random.choice(list(STRENGTHS[robot])))
        hidden = {name: STRENGTHS[robot][name]}
    elif kind == "outside":
        # Some robots diverge by a resonance, and a tank would be emptier than empty by what is no command.
        outside = str(
            random.choice(OUTSIDE[:5] if robot == "own_tank" else [name for name in OUTSIDE if name != "resonance"])
        )
    elif kind == "ordered_stop":
        return _stopped(plant, seed, random)
    elif kind == "end_stop":
        return _at_end_stop(robot, plant, seed)
    return Log(*drive(plant, hidden, seed, outside))


def _stopped(plant: Plant, seed: int, random: np.random.Generator) -> Log:
    """Halfway a brake holds the robot for a fifth of the log; all but the first command go on.

    Encoders stand to the last digit, and what is no encoder (the last position) goes on with its noise.
    """
    begin = float(random.uniform(0.4, 0.6)) * plant.seconds
    end, calls = begin + 0.2 * plant.seconds, [0]
    braked = [False]

    def control(state: Values, level: Values) -> Values:
        now = calls[0] * plant.period / 4.0
        calls[0] += 1
        braked[0] = begin <= now < end
        command = plant.control(state, level) if plant.control is not None else level.copy()
        if braked[0]:
            command[0] = 0.0
        return np.asarray(command, dtype=np.float64)

    encoders = [index for index, name in enumerate(plant.states) if name in _ENCODED]
    speeds = [index for index in range(len(plant.states)) if index not in encoders]

    def rates(state: Values, action: Values) -> Values:
        found = plant.rates(state, action)
        if braked[0]:
            found[speeds] = -state[speeds] / (5.0 * plant.period)
        return found

    log = Log(*drive(replace(plant, control=control, rates=rates), {}, seed))
    still = (log.t >= begin + 60.0 * plant.period) & (log.t < end - plant.period)
    for index in encoders[:-1] or encoders:
        log.states[still, index] = log.states[np.flatnonzero(still)[0], index]
    for index in speeds:
        log.states[still, index] = 0.0
    return log


_ENCODED: Final = {"x", "y", "yaw", "angle", "position"}
_ENDS: Final = {"own_servo": ("angle", 0.5), "own_joint": ("position", 0.5), "own_tank": ("level", 1.6)}
"""State with an end, and where it is."""


def _at_end_stop(robot: str, plant: Plant, seed: int) -> Log:
    """A stiff stop on either side, or an overflow, at which the sensor reads the same to the last digit."""
    if robot not in _ENDS:
        return Log(*drive(plant, {}, seed))
    name, limit = _ENDS[robot]
    at = plant.states.index(name)

    def rates(state: Values, action: Values) -> Values:
        found = plant.rates(state, action)
        beyond = float(state[at]) - float(np.clip(state[at], -limit, limit))
        if len(plant.states) > 1:
            found[1] -= (3000.0 * beyond + 60.0 * float(state[1])) if beyond else 0.0
        elif beyond > 0.0:
            found[at] = min(float(found[at]), 0.0)
        return found

    log = Log(*drive(replace(plant, rates=rates), {}, seed))
    log.states[:, at] = np.clip(log.states[:, at], -limit, limit)
    return log
