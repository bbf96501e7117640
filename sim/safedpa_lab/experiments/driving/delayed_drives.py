"""Drives of a car whose commands arrive late: does the filter that knows the delay, or does not, keep it safe?

Each drive is the pymunk car in lockstep with the real nodes of adaptation, policy and safety filter, in a scene drawn
from its seed. Where the services' model has the delay, the margin is calibrated for it, on drives of other seeds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from safedpa.bus import AbstractNode
from safedpa.calibration.from_drives import barrier_residuals
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration, calibration_from_errors
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa_lab.experiments.common.drives import (
    LOADS,
    PERIOD,
    Outcome,
    counted,
    driven_with_latents,
    shipped_nodes,
    statuses_of,
)
from safedpa_lab.experiments.record import ReportProgress, silent
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.car.robot import CarRobot, DelayedCommands
from safedpa_sim.robots.car.scene import Scene

CHANNELS = ("both", "drive", "steer")
"""Which commands arrive late."""
_EFFECTS = {"both": "actuator_delay", "drive": "drive_delay", "steer": "steering_delay"}
_LATE = "commands act about"
"""What every verdict about a delay says."""
_COVERAGE = 0.99
_CALIBRATION_SEED = 5_000_000
"""Far from the seeds of the drives that are counted."""


@dataclass(frozen=True)
class Lateness:
    """Delay of the commands, and which part knows it. Raises InputError for an invalid one."""

    seconds: float
    channel: str = "both"
    reported: str = "model"
    """``model``: an effect of the services' model; ``clock``: the robot measures it and says so with every state, as
    the time until its action acts; ``none``."""

    def __post_init__(self) -> None:
        if self.channel not in CHANNELS:
            raise InputError(f"channel: got {self.channel!r}, wanted one of {', '.join(CHANNELS)}")
        if self.reported not in ("model", "clock", "none"):
            raise InputError(f"reported: got {self.reported!r}, wanted one of model, clock, none")
        if self.reported == "clock" and self.channel != "both":
            raise InputError(f"channel: got {self.channel!r}, wanted both: the clock's delay holds for all commands")

    def robot(self, seed: int, load: str, heavier: float = 1.0) -> CarRobot:
        """The car, its commands late; ``heavier`` is a factor of the mass of its load."""
        drive_seconds, steer_seconds = (self.seconds if self.channel in ("both", one) else 0.0 for one in CHANNELS[1:])
        reported = self.seconds if self.reported == "clock" else 0.0
        late = DelayedCommands(drive_seconds, steer_seconds)
        scene = Scene.random(seed, load)
        if scene.load is not None and heavier != 1.0:
            scene = replace(scene, load=replace(scene.load, mass_ratio=heavier * scene.load.mass_ratio))
        return CarRobot(scene, PERIOD, late=late, until_action=reported)

    def model(self, name: str) -> PhysicsModel:
        """The services' model."""
        known = self.reported == "model" and self.seconds > 0.0
        return model_with_delay(load_model(name), self.seconds, self.channel) if known else load_model(name)


@dataclass
class DelayedDrives:
    """What became of some drives under one delay."""

    lateness: Lateness
    drives: int = 0
    collided: int = 0
    """Drives with a collision."""
    collisions: int = 0
    goals: int = 0
    least_h: float = float("inf")
    """Smallest barrier value that was measured, m."""
    statuses: Counter[str] = field(default_factory=Counter)
    """Verdicts by status."""
    reported: int = 0
    """Ticks whose verdict mentions that commands act late."""
    collided_after: int = 0
    """Drives with a collision after the first such verdict, later than a command of that verdict begins to act."""


def model_with_delay(model: PhysicsModel, seconds: float, channel: str = "both") -> PhysicsModel:
    """The model with the delay among its effects, known exactly."""
    return model.with_effect(effect("car", _EFFECTS[channel]), {"seconds": Setting(seconds)})


def margin_with_delay(
    lateness: Lateness, drives: int = 16, seconds: float = 12.0, *, model: str = "car"
) -> MarginCalibration:
    """The margin of a filter that knows the delay, from drives behind that filter with the margin of its settings.

    Steps are taken for exchangeable; a kind of barrier that too few of them came near keeps the settings' margin.
    Raises InputError when that is so of every kind.
    """
    known, settings, found = lateness.model(model), settings_named("car"), dict[str, list[Any]]()
    for index in range(drives):
        robot = lateness.robot(_CALIBRATION_SEED + index, LOADS[index % len(LOADS)])
        _, ticks = driven_with_latents(robot, shipped_nodes(known, settings), round(seconds / PERIOD))
        for kind, heights in barrier_residuals(known, settings, ticks).items():
            found.setdefault(kind, []).append(ErrorClip.of_settings(settings).errors(kind, heights))
    joined = {kind: np.concatenate(errors) for kind, errors in found.items()}
    near = {kind: errors for kind, errors in joined.items() if len(errors) >= smallest_sample(_COVERAGE)}
    made = calibration_from_errors(near, _COVERAGE, "simulated", fingerprint(known))
    made.epsilon.update({kind: settings.epsilon[kind] for kind in joined if kind not in near})
    return made


def delayed_drives(
    lateness: Lateness,
    drives: int,
    seed: int,
    seconds: float = 12.0,
    *,
    margin: MarginCalibration | None = None,
    loads: Sequence[str] = LOADS,
    model: str = "car",
    policy: Callable[[int], AbstractNode] | None = None,
    heavier: float = 1.0,
    on_drive: ReportProgress = silent,
) -> DelayedDrives:
    """Drives scene ``seed``, ``seed`` + 1, ... for ``seconds`` each, with ``loads`` in turn, one after the other.

    ``margin``: that of the model, by default the one that ships for it, or that of the settings. ``policy``: makes the
    node in place of the model's controller from the seed. ``heavier``: factor of the mass of the load. The same
    arguments give the same outcome, bit for bit.
    """
    known, outcomes, mentions = lateness.model(model), list[Outcome](), list[_Mentions]()
    for index in range(drives):
        robot = lateness.robot(seed + index, loads[index % len(loads)], heavier)
        own = () if policy is None else (policy(seed + index),)
        nodes = shipped_nodes(known, settings_named("car"), *own, margin=margin)
        mentions.append(_Mentions(robot, lateness.seconds))
        outcomes.append(counted(robot, mentions[-1].watched(drive(robot, nodes, round(seconds / PERIOD)))))
        on_drive(index + 1, drives)
    return DelayedDrives(
        lateness,
        drives,
        sum(one.collisions > 0 for one in outcomes),
        sum(one.collisions for one in outcomes),
        sum(one.goals for one in outcomes),
        min((one.least_h for one in outcomes), default=float("inf")),
        Counter(statuses_of(one.statuses for one in outcomes)),
        sum(one.ticks for one in mentions),
        sum(one.collided for one in mentions),
    )


class _Mentions:
    """Counts the verdicts of one drive that mention late commands, and whether it collides after them."""

    def __init__(self, robot: CarRobot, seconds: float) -> None:
        self._robot, self._seconds = robot, seconds
        self.ticks, self.collided = 0, False

    def watched(self, ticks: Iterable[Tick]) -> Iterator[Tick]:
        """The ticks themselves."""
        acts, before = float("inf"), 0
        for tick in ticks:
            now, collisions = tick.state.robot_time, len(self._robot.collisions)
            self.collided |= collisions > before and now > acts
            before = collisions
            if _LATE in tick.verdict.sentence.lower():
                self.ticks += 1
                acts = min(acts, now + self._seconds)
            yield tick
