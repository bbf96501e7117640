"""Cases on disk: ``given/`` with the model and the runs, and the truth in a file of its own next to it.

The runs are what the tracking system makes of the true ones: noise, lost rows, glitches.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa_lab.hidden.bad_data import BAD, write_bad_files
from safedpa_lab.hidden.car import ACCELERATION_LIMIT, WHEELBASE, simulate_cars
from safedpa_lab.hidden.case import LARGEST_STEER, Case, truth_of
from safedpa_lab.hidden.lanes import Lane, car_commands, markov, pendulum_commands, wheels_commands
from safedpa_lab.hidden.pendulum import GRAVITY, LENGTH, MASS, simulate_pendulums
from safedpa_lab.hidden.towing import drive_towing
from safedpa_lab.hidden.wheels import LIMIT, SERVO, TRACK, simulate_wheels
from safedpa_sim.robots.car.parameters import CAR_PARAMETERS

NOISE: Final[dict[str, tuple[float, ...]]] = {
    "car": (0.002, 0.002, 0.003, 0.015),
    "pendulum": (0.002, 0.01),
    "differential_drive": (0.002, 0.002, 0.003, 0.01, 0.02),
}
"""Standard deviations of the states' noise: m, m, rad, m/s; rad, rad/s; m, m, rad, m/s, rad/s."""

_HARDER = 3.0
_LOST = 0.01
_GLITCHES = 3
"""In each hard run."""


def measured(
    states: FloatArray, robot: str, random: np.random.Generator, hard: bool
) -> tuple[FloatArray, NDArray[np.int64]]:
    """Measured states and the rows (kept,) that arrived, of one run (rows, states)."""
    noise = np.array(NOISE[robot]) * (_HARDER if hard else 1.0)
    shown = states + noise * random.standard_normal(states.shape)
    retained = np.ones(len(states), dtype=bool)
    if hard:
        retained[1:-1] = random.random(len(states) - 2) >= _LOST
        _glitch(shown, random)
    return shown, np.flatnonzero(retained)


def _glitch(shown: FloatArray, random: np.random.Generator) -> None:
    """The track jumps to something else for one to three rows, and back."""
    for _ in range(_GLITCHES):
        row = int(random.integers(5, len(shown) - 8))
        rows = slice(row, row + int(random.integers(1, 4)))
        shown[rows, :2] += random.choice([-1.0, 1.0], 2) * random.uniform(0.5, 1.5, 2)


PERIOD: Final[dict[str, float]] = {"car": 0.05, "pendulum": 0.02, "differential_drive": 0.05}
"""s between rows."""

_SERVO_GAIN = 3.0
"""1/s in the given model."""
_DRIVE_GAIN = 4.5
"""m/s2 in the given model."""
_OFF = 0.1
"""Relative error of the given gain in hard cases."""
_COLOURED = {"car": (0.15, 0.05), "pendulum": (0.3, 0.0), "differential_drive": (0.05, 0.2)}
"""Standard deviations of the disturbance: m/s2 and rad/s; rad/s2."""
_COLUMNS = {
    "car": ("x", "y", "yaw", "speed"),
    "pendulum": ("angle", "rate"),
    "differential_drive": ("x", "y", "yaw", "speed", "turn_rate"),
}
_SIMULATES = {"car": simulate_cars, "pendulum": simulate_pendulums, "differential_drive": simulate_wheels}


@dataclass(frozen=True)
class Log:
    """Where a case lies. Anyone who diagnoses may look into ``given`` alone."""

    case: Case
    folder: Path

    @property
    def model(self) -> Path:
        """The given model, without what is hidden."""
        return self.folder / "given" / "model.toml"

    @property
    def runs(self) -> list[Path]:
        """The runs, in order."""
        return sorted((self.folder / "given").glob("run_*.csv"))

    @property
    def truth(self) -> Path:
        """The sealed truth."""
        return self.folder / "truth.json"


def write_case(case: Case, folder: Path) -> Log:
    """Simulates one case and writes it into ``folder``."""
    return write_cases([case], [folder])[0]


def write_cases(cases: Sequence[Case], folders: Sequence[Path]) -> list[Log]:
    """Several cases at once: what is integrated runs side by side, which is many times faster."""
    driven = _driven(cases)
    return [_write(case, folder, runs) for case, folder, runs in zip(cases, folders, driven, strict=True)]


def _driven(cases: Sequence[Case]) -> list[list[tuple[FloatArray, FloatArray]]]:
    """True states and actions of each run of each case; cases of one kind and length share one integration."""
    found: dict[int, list[tuple[FloatArray, FloatArray]]] = {}
    kinds: dict[tuple[str, float], list[int]] = {}
    for number, case in enumerate(cases):
        if case.load is not None:
            rows = round(case.seconds / PERIOD["car"])
            found[number] = [
                drive_towing(case.load, _random(case, run, 0), rows, PERIOD["car"]) for run in range(case.runs)
            ]
        else:
            kinds.setdefault((case.robot, case.seconds), []).append(number)
    for (robot, _), numbers in kinds.items():
        lanes = [lane for number in numbers for lane in _lanes(cases[number])]
        done = _SIMULATES[robot](lanes, PERIOD[robot])
        pairs = list(zip(done.states, done.actions, strict=True))
        for number in numbers:
            found[number], pairs = pairs[: cases[number].runs], pairs[cases[number].runs :]
    return [found[number] for number in range(len(cases))]


def _lanes(case: Case) -> list[Lane]:
    return [_lane(case, run) for run in range(case.runs)]


def _lane(case: Case, run: int) -> Lane:
    random = _random(case, run, 0)
    period = PERIOD[case.robot]
    rows = round(case.seconds / period)
    if case.robot == "car":
        commands = car_commands(random, rows, period, LARGEST_STEER)
        start = (*random.uniform(-2.0, 2.0, 2), random.uniform(-3.0, 3.0), random.uniform(0.0, 1.0))
    elif case.robot == "differential_drive":
        commands = wheels_commands(random, rows, period)
        start = (*random.uniform(-2.0, 2.0, 2), random.uniform(-3.0, 3.0), 0.0, 0.0)
    else:
        commands = pendulum_commands(random, rows, period)
        start = (np.pi + random.uniform(-1.0, 1.0), random.uniform(-1.0, 1.0))
    return Lane(
        effects=case.effects,
        commands=commands,
        start=tuple(float(value) for value in start),
        gain=_true_gain(case),
        throttle=case.drive == "throttle",
        disturbance=markov(random, rows, period, _COLOURED[case.robot]) if case.hard else None,
    )


def _true_gain(case: Case) -> float:
    gain = _DRIVE_GAIN if case.drive == "throttle" else _SERVO_GAIN
    return gain * (1.0 + float(_random(case, 0, 2).choice([-_OFF, _OFF]))) if case.hard else gain


def _random(case: Case, run: int, use: int) -> np.random.Generator:
    """One stream for each run and use (0 driving, 1 sensor, 2 the case's own numbers)."""
    return np.random.default_rng([case.seed, run, use])


def _write(case: Case, folder: Path, runs: Sequence[tuple[FloatArray, FloatArray]]) -> Log:
    log = Log(case, folder)
    log.model.parent.mkdir(parents=True, exist_ok=True)
    log.model.write_text(_model(case), encoding="utf-8")
    for number, (states, actions) in enumerate(runs):
        _write_run(case, folder / "given" / f"run_{number + 1}.csv", number, states, actions)
    if case.fault is not None:
        _spoil(log, case.fault)
    log.truth.write_text(json.dumps(truth_of(case), indent=1) + "\n", encoding="utf-8")
    return log


def _spoil(log: Log, fault: str) -> None:
    """Puts the bad file in the place of the first run; next to it where it is a copy of it."""
    good = log.runs[0]
    with TemporaryDirectory() as folder:
        bad = write_bad_files(good, Path(folder), (fault,))[fault].read_text(encoding="utf-8")
    copy = BAD[fault].kind == "same_recording"
    (good.with_name(f"run_{log.case.runs + 1}.csv") if copy else good).write_text(bad, encoding="utf-8")


def _write_run(case: Case, path: Path, number: int, states: FloatArray, actions: FloatArray) -> None:
    shown, retained = measured(states, case.robot, _random(case, number, 1), case.hard)
    time = PERIOD[case.robot] * np.arange(len(states))
    table = np.column_stack([time, shown, actions])[retained]
    if case.robot == "car":
        reported: tuple[str, ...] = ("target_speed" if case.drive == "speed_servo" else "throttle", "steer")
    else:
        reported = ("torque",) if case.robot == "pendulum" else ("target_speed", "target_turn_rate")
    names = ("t", *_COLUMNS[case.robot], *reported)
    np.savetxt(path, table, fmt="%.9g", delimiter=",", header=",".join(names), comments="")


def _model(case: Case) -> str:
    """The given model: what is known, without anything that is hidden."""
    if case.robot == "pendulum":
        base = [f"length = {LENGTH}", f"mass = {MASS}", f"gravity = {GRAVITY}"]
        return _toml("pendulum", "rigid_pendulum", base)
    if case.robot == "differential_drive":
        own = [f"track = {TRACK}", f"gain = {SERVO}", f"acceleration_limit = {LIMIT}"]
        return _toml("differential_drive", "servo_wheels", own)
    if case.load is not None:
        return _measured_car()
    if case.drive == "throttle":
        own = [f"drive_gain = {_setting(_DRIVE_GAIN, case.hard)}"]
    else:
        own = [f"speed_gain = {_setting(_SERVO_GAIN, case.hard)}", f"acceleration_limit = {ACCELERATION_LIMIT}"]
    return _toml("car", "kinematic_bicycle", [f'drive = "{case.drive}"', f"wheelbase = {WHEELBASE}", *own])


def _measured_car() -> str:
    """The pymunk car as it is without a load, but for what its actuators and tyres do late and sideways."""
    car = CAR_PARAMETERS
    servo = [f"speed_gain = {car.servo_gain}", f"acceleration_limit = {car.servo_limit}"]
    known = []
    for line in (f"rolling_resistance.deceleration = {car.rolling}", f"quadratic_drag.coefficient = {car.drag}"):
        name, number = line.split(".", 1)
        known += ["", "[[effects]]", f'name = "{name}"', number]
    return _toml("car", "kinematic_bicycle", ['drive = "speed_servo"', f"wheelbase = {WHEELBASE}", *servo, *known])


def _setting(value: float, free: bool) -> str:
    return f"{{ value = {value}, free = true }}" if free else str(value)


def _toml(robot: str, kind: str, base: list[str]) -> str:
    lines = ["format = 1", f'robot = "{robot}"', f"period = {PERIOD[robot]}", "", "[base]", f'kind = "{kind}"', *base]
    return "\n".join(lines) + "\n"
