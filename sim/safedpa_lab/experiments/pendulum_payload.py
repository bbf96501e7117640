"""A user's pendulum with a payload that no one told: is it named, and how heavy is it?

The system is identified from the logs of a real one (DFKI's torque-limited pendulum): its mass and the friction that
diagnosis finds. The user's robot is a simulation of it, written again (``PendulumWorld``), with more at its tip and
noisy sensors; its logs go to the diagnosis with the identified model, mass fixed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import PhysicsModel, Setting, load_model, parse_model, write_model
from safedpa.errors import InputError
from safedpa.records.run import Run, Stretch
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.experiments.real_logs_data import PENDULUM, mapped_runs, paths_of
from safedpa_lab.pendulum.hidden import PERIOD, swing_at_random
from safedpa_sim.robots.pendulum_world import PendulumParameters, PendulumWorld

__all__ = ["PayloadCases", "diagnosed_payload", "identified_pendulum", "payload_cases"]

_HORIZON = 0.4
"""s"""
_TORQUE = 2.5
"""N m; about what the real motor gives."""
_HELD = (10, 60)
"""Periods for which a torque is held."""
_NOISE = (0.002, 0.01)
"""rad and rad/s; standard deviations of what the sensors add."""


@final
@dataclass(frozen=True)
class PayloadCases:
    """What is to be run. Raises InputError where there is no log of the real pendulum under ``data``."""

    data: Path
    masses: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    """kg"""
    seeds: tuple[int, ...] = (0, 1, 2)
    runs: int = 3
    seconds: float = 20.0
    processes: int = 2

    def __post_init__(self) -> None:
        if not paths_of(self.data, PENDULUM):
            raise InputError(f"--data {self.data}: got no {PENDULUM} under it, wanted logs of DFKI's pendulum")


def identified_pendulum(data: Path) -> PhysicsModel:
    """The real pendulum as its logs tell it: what diagnosis made of the shipped model, nothing of it free any more."""
    model = load_model("dfki_pendulum")
    found = diagnose(model, mapped_runs(paths_of(data, PENDULUM), model, "dfki_pendulum_columns"), _HORIZON).models[-1]
    return found.with_settings({path: Setting(item.value) for path, item in found.settings.items()})


def payload_cases(
    cases: PayloadCases, report_progress: Callable[[int, int], None] = lambda _done, _all: None
) -> dict[str, Any]:
    """The identified numbers; for each payload and seed what was named first, the mass and its deviation; how many."""
    identified = identified_pendulum(cases.data)
    text = write_model(identified)
    work = [(text, mass, seed, cases.runs, cases.seconds) for mass in (0.0, *cases.masses) for seed in cases.seeds]
    rows = []
    with Workers(cases.processes) as workers:
        for row in workers.map(diagnosed_payload, work):
            rows.append(row)
            report_progress(len(rows), len(work))
    loaded = [row for row in rows if row["mass"] > 0.0]
    return {
        "identified": {path: item.value for path, item in identified.settings.items()},
        "rows": rows,
        "first": sum(row["first"] == "tip_mass" for row in loaded),
        "within_two_deviations": sum(bool(row["within"]) for row in loaded),
        "cases": len(loaded),
        "false_alarms": sum(row["added"] != [] for row in rows if row["mass"] == 0.0),
    }


def diagnosed_payload(work: tuple[str, float, int, int, float]) -> dict[str, Any]:
    """One case: what diagnosis says of (identified model as TOML, payload [kg], seed, logs, seconds of each)."""
    text, mass, seed, count, seconds = work
    model = parse_model(text)
    found = diagnose(model, _logs(model, mass, seed, count, seconds), _HORIZON)
    value = found.parameters.get("tip_mass.mass")
    off = None if value is None or value.std is None else abs(value.value - mass) / value.std
    return {
        "mass": mass,
        "seed": seed,
        "added": list(found.added),
        "first": found.added[0] if found.added else "",
        "value": None if value is None else value.value,
        "std": None if value is None else value.std,
        "within": off is not None and off <= 2.0,
        "error": [stage.heldout_error for stage in found.stages],
    }


def _logs(model: PhysicsModel, mass: float, seed: int, count: int, seconds: float) -> Sequence[Run]:
    """Logs of the user's robot: torques at random from hanging, each held for a while, read by noisy sensors."""
    value = {path: item.value for path, item in model.settings.items()}
    body = PendulumParameters(
        length=value["base.length"],
        mass=value["base.mass"],
        friction=value.get("viscous_friction.coefficient", 0.0),
        drag=0.0,
        payload=mass,
        dry_friction=value.get("coulomb_friction.torque", 0.0),
    )
    rows, runs = round(seconds / PERIOD), []
    for number in range(count):
        random = np.random.default_rng([seed, number, 8])
        world = PendulumWorld(np.pi, parameters=body)
        states, torques = swing_at_random(world, random, rows, _TORQUE, _HELD)
        seen = states + random.normal(0.0, _NOISE, states.shape)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"log {number + 1}", model.system, t, seen, torques, (Stretch(0, rows),)))
    return runs
