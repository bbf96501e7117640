"""What a learned model can be tuned on: recorded runs, or a clear word why not; and circles, recorded here.

The few real data of the paper are "circles without load", and it says no more. Here a circle is a target speed and a
steer that are held for 1 to 3 s; then both are redrawn from the whole range of commands, on the pymunk car. So every
radius and speed comes, the lag of the steering and of the motor shows at each change, and so do reverse and braking.
What is towed in the experiment never occurs here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import pi
from pathlib import Path
from typing import NamedTuple

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import Description, Weights, frame_of
from safedpa.records import Run, Stretch, load_column_map, load_run
from safedpa.robots.car.system import CAR
from safedpa.systems import System
from safedpa_sim.robots.car_parameters import CAR_PARAMETERS
from safedpa_sim.robots.world import CarWorld

__all__ = ["HORIZON", "PERIOD", "TuningDrive", "drives_of", "load_tuning_runs", "record_circles", "split"]

PERIOD = 0.05
"""s."""

_HOLD = (1.0, 3.0)
"""s; shortest and longest time for which a circle is driven."""
_STANDING = 0.05
"""Share of the circles that are a stop: standing occurs in every drive, and draws from a range would never give it."""
_FIELD = (-1e3, 1e3, -1e3, 1e3)
"""m; no wall is ever reached."""


def record_circles(
    pairs: int,
    seed: int,
    run_pairs: int = 1000,
    on_run: Callable[[int, int], None] = lambda _done, _all: None,
) -> tuple[Run, ...]:
    """Runs of ``run_pairs`` transitions each, at least ``pairs`` in all; the same seed gives the same runs.

    Raises InputError when fewer than one run or no transition is asked for.
    """
    if pairs < 1 or run_pairs < 2:
        raise InputError(f"circles: got {pairs} pairs in runs of {run_pairs}, wanted at least 1 in runs of 2 or more")
    count = -(-pairs // run_pairs)
    runs = []
    for index in range(count):
        runs.append(_recorded(f"circles_{index:02d}", np.random.default_rng([seed, index]), run_pairs))
        on_run(index + 1, count)
    return tuple(runs)


def _circle_commands(random: np.random.Generator, rows: int) -> FloatArray:
    """Actions (rows, 2): target speed [m/s] and steer [rad], held for 1 to 3 s each."""
    car = CAR_PARAMETERS
    actions = np.empty((rows, 2))
    at = 0
    while at < rows:
        count = round(float(random.uniform(*_HOLD)) / PERIOD)
        speed = float(random.uniform(car.speed_low, car.speed_high))
        steer = float(random.uniform(-car.steer_limit, car.steer_limit))
        actions[at : at + count] = (0.0 if random.random() < _STANDING else speed), steer
        at += count
    return actions


def _recorded(name: str, random: np.random.Generator, pairs: int) -> Run:
    """One run of pairs + 1 rows from a standing start; the last row's action is that of the row before."""
    world = CarWorld((0.0, 0.0, float(random.uniform(-pi, pi))), _FIELD)
    actions = _circle_commands(random, pairs)
    states = np.empty((pairs + 1, len(CAR.state)))
    states[0] = world.state
    for row, (speed, steer) in enumerate(actions.tolist()):
        world.advance(speed, steer, PERIOD)
        states[row + 1] = world.state
    t = PERIOD * np.arange(pairs + 1, dtype=np.float64)
    return Run(name, CAR, t, states, np.vstack([actions, actions[-1:]]), (Stretch(0, pairs + 1),))


HORIZON = 20
"""Steps that predictions are judged over; a drive must be so much longer than the history."""
_HELD_OUT = 0.2
"""Share of the data that nothing is fitted to."""
_OUTSIDE = 0.01
"""Share of rows whose action may lie outside the range that the networks were trained on."""
_BEYOND = 0.02
"""Of the range, by which an action may exceed it: rounding of a log."""
_STILL = 0.02
"""A signal whose standard deviation is less than this share of its trained range's half counts as constant."""
_PERIOD = 0.05
"""Share by which a run's period may differ from the networks'."""


class TuningDrive(NamedTuple):
    """States (n + 1, states) and actions (n, actions), one period apart, without a gap."""

    states: FloatArray
    actions: FloatArray


def load_tuning_runs(
    paths: Sequence[Path], columns: Path | None, system: System, weights: Weights
) -> list[TuningDrive]:
    """The drives in recorded files. Raises InputError naming the file and what is missing in it."""
    mapping = load_column_map(columns) if columns is not None else None
    return drives_of([load_run(path, system, mapping) for path in paths], weights)


def drives_of(runs: Sequence[Run], weights: Weights) -> list[TuningDrive]:
    """The stretches of runs that are long enough for the history.

    Raises InputError when a run has another period, when no stretch is longer than the history and a second to predict,
    when actions lie outside the trained range, or when a signal is not excited.
    """
    described = weights.description
    needed = described.history + HORIZON
    drives = []
    for run in runs:
        _check_period(run, described)
        parts = [TuningDrive(states, actions[:-1]) for _, states, actions in run.parts() if len(states) > needed]
        if not parts:
            longest = max((len(part) for part in run.stretches), default=0)
            raise InputError(
                f"{run.name}: the longest stretch without a gap has {longest} rows, wanted more than {needed} (a "
                f"history of {described.history} and {HORIZON} steps to predict); record longer, or tune on other runs"
                + _findings(run)
            )
        for part in parts:
            _check_range(run.name, part, weights)
        drives += parts
    if not drives:
        raise InputError("runs: got none, wanted at least one to tune on")
    _check_excitation(drives, weights)
    return drives


def split(drives: Sequence[TuningDrive], history: int) -> tuple[list[TuningDrive], list[TuningDrive]]:
    """Drives to fit, and drives to judge by: whole ones where there are several, else the end of the one.

    Raises InputError when a single drive is too short to be divided.
    """
    if len(drives) > 1:
        retained = max(1, min(len(drives) - 1, round((1.0 - _HELD_OUT) * len(drives))))
        return list(drives[:retained]), list(drives[retained:])
    states, actions = drives[0]
    needed = history + HORIZON
    last = max(needed, round(_HELD_OUT * len(actions)))
    first = len(actions) - last
    if first <= needed:
        raise InputError(
            f"runs: one stretch of {len(states)} rows, wanted more than {2 * needed}: one part to tune on and one to "
            "judge by; record longer, or give a second run"
        )
    return [TuningDrive(states[: first + 1], actions[:first])], [TuningDrive(states[first:], actions[first:])]


def _check_period(run: Run, described: Description) -> None:
    wanted = described.period
    if not abs(run.period - wanted) <= _PERIOD * wanted:
        raise InputError(
            f"{run.name}: a row every {run.period:.4g} s, wanted every {wanted:g} s as the networks were trained; "
            "record at that rate, keep every n-th row with keep_period in a column map, or train for this period"
        )
    steps = np.concatenate([np.diff(run.t[part.start : part.stop]) for part in run.stretches])
    uneven = float(np.mean(np.abs(steps - wanted) > 0.2 * wanted))
    if uneven > _PERIOD:
        raise InputError(
            f"{run.name}: {100 * uneven:.0f} % of the rows do not follow after {wanted:g} s, wanted even sampling; "
            "networks tell the change over one period and no other"
        )


def _check_range(name: str, drive: TuningDrive, weights: Weights) -> None:
    scaled = (drive.actions - weights["action_middle"]) / weights["action_scale"]
    outside = np.abs(scaled) > 1.0 + 2.0 * _BEYOND
    for index, action in enumerate(weights.description.actions):
        share = float(outside[:, index].mean())
        if share > _OUTSIDE:
            middle, half = float(weights["action_middle"][index]), float(weights["action_scale"][index])
            values = drive.actions[:, index]
            raise InputError(
                f"{name}: {action} from {values.min():.3g} to {values.max():.3g}, wanted within {middle - half:.3g} "
                f"to {middle + half:.3g}, the range trained on ({100 * share:.0f} % of the rows lie "
                "outside); check the units, or train with a wider [action]"
            )


def _check_excitation(drives: Sequence[TuningDrive], weights: Weights) -> None:
    """Every action and everything that the networks see of the state must vary over all drives together."""
    frame = frame_of(weights.description.robot)
    actions = np.concatenate([drive.actions for drive in drives])
    features = frame.features(np.concatenate([drive.states for drive in drives]))
    signals = (
        (weights.description.actions, actions, weights["action_scale"]),
        (frame.feature_names, features, weights["feature_scale"]),
    )
    for names, values, scale in signals:
        for name, spread, half in zip(names, values.std(axis=0).tolist(), scale.tolist(), strict=True):
            if spread < _STILL * half:
                raise InputError(
                    f"runs: {name} hardly changes (standard deviation {spread:.2g}), so nothing can be learned of its "
                    "effect; wanted runs in which every action and the motion vary: circles of several radii and "
                    "speeds, say"
                )


def _findings(run: Run) -> str:
    return "; the data: " + "; ".join(item.message for item in run.findings) if run.findings else ""
