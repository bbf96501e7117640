"""Recorded runs for tuning: loading, checks and split, and circles recorded from the pymunk car.

The paper specifies its real data only as "circles without load". Here a circle is a target speed and a steering angle
that are held for 1 to 3 s on the pymunk car; then both are redrawn from the whole range of commands. The runs therefore
cover all radii and speeds, reverse, braking, and the lag of steering and motor at each change, but never a load.
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
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS
from safedpa_sim.robots.car.world import CarWorld

PERIOD = 0.05
"""s."""

_HOLD = (1.0, 3.0)
"""s; shortest and longest duration of a circle."""
_STANDING = 0.05
"""Share of the circles with speed 0: every real drive has stops, and a uniform draw would never give exactly 0."""
_FIELD = (-1e3, 1e3, -1e3, 1e3)
"""m; so large that no wall is ever reached."""


def record_circles(
    pairs: int, seed: int, run_pairs: int = 1000, on_run: Callable[[int, int], None] = lambda _done, _all: None
) -> tuple[Run, ...]:
    """Records runs of ``run_pairs`` transitions each, at least ``pairs`` in total; deterministic in ``seed``.

    Raises InputError for ``pairs`` below 1 or ``run_pairs`` below 2.
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
    """Draws actions (rows, 2): target speed [m/s] and steer [rad], held for 1 to 3 s each."""
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
    """Records one run of pairs + 1 rows from standstill; the action of the last row repeats the one before."""
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
"""Steps over which predictions are evaluated; a drive must be longer than the history by this much."""
_HELD_OUT = 0.2
"""Share of the data that is held out."""
_OUTSIDE = 0.01
"""Share of rows whose action may lie outside the range that the networks were trained on."""
_BEYOND = 0.02
"""Tolerance for rounding in logs, as a share of the range by which an action may exceed it."""
_CONSTANT = 0.02
"""A signal counts as constant if its standard deviation is below this share of half its trained range."""
_PERIOD = 0.05
"""Largest relative difference between the period of a run and that of the networks."""


class TuningDrive(NamedTuple):
    """A drive without gaps: states (n + 1, states) and actions (n, actions), one period apart."""

    states: FloatArray
    actions: FloatArray


def load_tuning_runs(
    paths: Sequence[Path], columns: Path | None, system: System, weights: Weights
) -> list[TuningDrive]:
    """Loads the drives in recorded files. Raises InputError naming the file and what is wrong with it."""
    mapping = load_column_map(columns) if columns is not None else None
    return drives_of([load_run(path, system, mapping) for path in paths], weights)


def drives_of(runs: Sequence[Run], weights: Weights) -> list[TuningDrive]:
    """Returns the stretches of runs that are long enough for the history of the networks.

    Raises InputError when a run has another period, when no stretch is longer than the history plus ``HORIZON``, when
    actions lie outside the trained range, or when a signal is not excited.
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
    """Splits drives into training and held-out drives: whole drives, or the end of a single one.

    Raises InputError when a single drive is too short to be split.
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
            "evaluate; record longer, or give a second run"
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
            "the networks predict the change over exactly one period"
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
    """Raises InputError unless every action and every feature of the state varies over all drives together."""
    frame = frame_of(weights.description.robot)
    actions = np.concatenate([drive.actions for drive in drives])
    features = frame.features(np.concatenate([drive.states for drive in drives]))
    signals = (
        (weights.description.actions, actions, weights["action_scale"]),
        (frame.feature_names, features, weights["feature_scale"]),
    )
    for names, values, scale in signals:
        for name, spread, half in zip(names, values.std(axis=0).tolist(), scale.tolist(), strict=True):
            if spread < _CONSTANT * half:
                raise InputError(
                    f"runs: {name} hardly changes (standard deviation {spread:.2g}), so its effect cannot be learned; "
                    "wanted runs in which every action and the motion vary, such as circles of several radii and speeds"
                )


def _findings(run: Run) -> str:
    return "; the data: " + "; ".join(item.message for item in run.findings) if run.findings else ""
