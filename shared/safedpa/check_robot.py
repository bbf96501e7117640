"""Checks whether a declared robot is complete and can be filtered safely; returns one sentence per part.

Drives the stand-in with random nominal actions behind the robot's own filter. Then tests barriers, backup and margin at
the visited states (``check_filter``), and checks that settings of another robot are rejected.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.drawing import Discs, Lines, Rings
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.effects import effects_of
from safedpa.errors import InputError, SafedpaError, described
from safedpa.networks.frame import Frame
from safedpa.policy.controller import controller_for
from safedpa.runtime.scene import NO_SENSES, AbstractScene, scene_of
from safedpa.safety.checks.check_filter import check_filter
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.session.filter_session import FilterSession
from safedpa.safety.settings import FilterSettings
from safedpa.safety.validation import checked_output
from safedpa.stand_in import AbstractStandIn
from safedpa.systems.robots import Robot, robots

__all__ = ["PartFinding", "check_robot"]


_TICKS = 200
# States of the drive at which barriers and backup are tested.
_PROBED = 5
# Median one-step error in measurement deviations above which there is a note on the model.
_FAR_OFF = 5.0


@final
@dataclass(frozen=True)
class PartFinding:
    """Result of the check of one part."""

    part: str
    verdict: Literal["fine", "note", "missing", "wrong"]
    sentence: str

    @property
    def ends_well(self) -> bool:
        """Whether the robot can be driven with this part."""
        return self.verdict in ("fine", "note")


def check_robot(robot: Robot, seed: int = 0) -> list[PartFinding]:
    """Checks the parts of a robot in order of their dependencies; ends at a part on which the next ones depend.

    Exceptions of the robot's own code are reported in the result.
    """
    found: list[PartFinding] = []
    try:
        found.extend(_parts(robot, seed))
    except _EndError as end:
        found.append(end.finding)
    return found


class _EndError(Exception):
    def __init__(self, finding: PartFinding) -> None:
        super().__init__(finding.sentence)
        self.finding = finding


def _tried(part: str, function: Callable[[], Any]) -> Any:
    """Calls a function of the robot; an exception ends the check with a sentence."""
    try:
        return function()
    except SafedpaError as error:
        raise _EndError(PartFinding(part, "wrong", str(error))) from error
    except Exception as error:  # a user's code may raise anything; reporting it is the purpose of the check
        raise _EndError(PartFinding(part, "wrong", f"raised {described(error)}")) from error


def _parts(robot: Robot, seed: int) -> Iterator[PartFinding]:
    system = robot.system
    notice = _message_of_deviations(robot)
    if notice:
        raise _EndError(PartFinding("measurement_deviation", "wrong", notice))
    yield PartFinding(
        "system", "fine", f"states {', '.join(system.state_names)}; actions {', '.join(system.action_names)}"
    )
    model: PhysicsModel = _tried("model", lambda: load_model(str(robot.model)))
    if model.system != system:
        notice = f"{robot.model} is a model of '{model.system.name}' with {', '.join(model.system.action_names)}"
        raise _EndError(PartFinding("model", "wrong", f"{notice}, wanted this robot's system"))
    free = ", ".join(model.latent_names) or "nothing"
    yield PartFinding("model", "fine", f"{robot.model}; estimated while it drives: {free}")
    effects = _tried("effects", lambda: effects_of(robot.name))
    notice = f"{len(effects)} that a diagnosis may find" if effects else "none; declare EFFECTS"
    yield PartFinding("effects", "fine" if effects else "missing", notice)
    settings: FilterSettings = _tried("settings", robot.settings)
    scene: AbstractScene = _tried("settings", lambda: scene_of(model, settings))
    yield _senses(scene)
    yield PartFinding("settings", "fine", f"bounds {settings.action_low} to {settings.action_high}")
    yield _foreign_settings(robot, model)
    frame = _tried("frame", robot.frame)
    if frame is not None and not isinstance(frame, Frame):
        yield PartFinding("frame", "wrong", f"got {type(frame).__name__}, wanted a Frame, or None without networks")
    stand_in = _tried("stand_in", lambda: robot.stand_in(seed, {}))
    if not isinstance(stand_in, AbstractStandIn):
        notice = f"got {type(stand_in).__name__}, wanted an AbstractStandIn"
        raise _EndError(PartFinding("stand_in", "wrong", notice))
    drive = _tried("barriers", lambda: _Drive(robot, model, settings, scene, stand_in).run(_TICKS, seed))
    yield from _driven(robot, model, drive)
    yield _nominal_part(model, drive)
    yield _drawing(robot, drive)


def _message_of_deviations(robot: Robot) -> str:
    """Returns what is wrong with the measurement deviations; empty if they are valid."""
    names, given = robot.system.state_names, robot.measurement_deviation
    try:
        numbers = checked_output("measurement_deviation", given)
    except InputError:
        return f"got {given!r}, wanted one number for each of {', '.join(names)}"
    if numbers.shape != (len(names),):
        return f"got {numbers.size} entries, wanted one for each of {', '.join(names)}"
    if not (np.isfinite(numbers).all() and (numbers > 0.0).all()):
        return f"got {given!r}, wanted a positive number for each of {', '.join(names)}"
    return ""


def _senses(scene: AbstractScene) -> PartFinding:
    """Reports whether the robot can drive with sensors; it may do without."""
    if scene.senses:
        return PartFinding("sensors", "fine", "its barriers take laser scans and other sensors (planar_body)")
    return PartFinding("sensors", "note", f"none: {NO_SENSES}")


def _foreign_settings(robot: Robot, model: PhysicsModel) -> PartFinding:
    """Checks that settings of every other robot are rejected."""
    accepted = []
    for name, other in robots().items():
        if name == robot.name:
            continue
        try:
            scene_of(model, other.settings())
        except InputError:
            continue
        accepted.append(name)
    if accepted:
        return PartFinding("foreign settings", "wrong", f"those of {', '.join(accepted)} are accepted; set system")
    return PartFinding("foreign settings", "fine", "settings of every other robot are rejected")


class _Drive:
    """A drive of the stand-in behind the robot's filter with random nominal actions; records what occurs."""

    def __init__(
        self,
        robot: Robot,
        model: PhysicsModel,
        settings: FilterSettings,
        scene: AbstractScene,
        stand_in: AbstractStandIn,
    ) -> None:
        self.robot, self.model, self.settings, self.scene, self.stand_in = robot, model, settings, scene, stand_in
        self.filter = SafetyFilter.for_model(model, settings, backup=scene.backup)
        self.states: list[StateMessage] = []
        self.errors: list[FloatArray] = []
        self.problems: list[str] = []
        self.touched = ""
        self.count = 0
        """Maximum number of barriers at a state."""

    def run(self, ticks: int, seed: int) -> _Drive:
        """Runs the drive."""
        # Each nominal action is held for half a second; with a new one in each tick, the robot would hardly move.
        random = np.random.default_rng(seed)
        low, high = self.settings.low, self.settings.high
        held = max(1, round(0.5 * self.robot.rate))
        latent = self.model.latent if self.model.latent_names else None
        applied = self.settings.resting_action
        nominal = applied
        for tick in range(ticks):
            if tick % held == 0:
                nominal = random.uniform(low, high)
            state = self._message(tick, applied)
            self.states.append(state)
            self.scene.learn(latent)
            barriers = self.scene.of(state)
            if isinstance(barriers, str):
                self.problems.append(barriers)
                return self
            self.count = max(self.count, len(barriers.names))
            before = np.array(state.values)
            verdict = self.filter.decide(state.values, nominal, latent, barriers=barriers) if barriers.names else None
            if verdict is not None and verdict.status.value == "fallback":
                self.problems.append(verdict.sentence)
            applied = np.clip(nominal, low, high) if verdict is None else np.asarray(verdict.action)
            expected = np.asarray(self.model.step(before, applied, latent))
            self.stand_in.advance(tuple(applied.tolist()), 1.0 / self.robot.rate)
            error = self.model.system.difference(np.array(self.stand_in.values), expected)
            self.errors.append(np.abs(error) / np.array(self.robot.measurement_deviation))
            self.touched = self.touched or self.stand_in.contact()
        return self

    def _message(self, tick: int, applied: FloatArray) -> StateMessage:
        seen = self.stand_in
        return StateMessage(
            epoch=1,
            tick=tick,
            robot_time=tick / self.robot.rate,
            publish_time=0.0,
            values=tuple(seen.values),
            applied=tuple(applied.tolist()),
            applied_by="filter",
            period=1.0 / self.robot.rate,
            lockstep=True,
            goal=tuple(seen.goal),
            obstacles=tuple(seen.obstacles),
            field=tuple(seen.field),
            footprint=(),
        )


def _driven(robot: Robot, model: PhysicsModel, drive: _Drive) -> Iterator[PartFinding]:
    """Checks stand-in, model, barriers and backup from the drive."""
    for message in drive.states:
        if not model.system.is_plausible(np.array(message.values)):
            yield PartFinding("stand_in", "wrong", f"its state {message.values} is out of the system's bounds")
            return
    if drive.problems:
        yield PartFinding("barriers", "wrong", drive.problems[0])
        return
    if not drive.count:
        yield PartFinding("barriers", "missing", "none at any state of a drive; the filter has nothing to enforce")
        return
    yield PartFinding("barriers", "fine", f"up to {drive.count} at once in {len(drive.states)} ticks")
    yield _nothing_perceived(drive)
    yield from _probed(robot, drive)
    if drive.touched:
        yield PartFinding(
            "filter", "wrong", f"touched {drive.touched} behind it, under random nominal actions; see the margins"
        )
    else:
        yield PartFinding("filter", "fine", f"nothing touched in {len(drive.states)} ticks of random nominal actions")
    median = np.median(np.array(drive.errors), axis=0)
    worst = int(median.argmax())
    name = model.system.state_names[worst]
    notice = f"single steps of {name} missed by {median[worst]:.2g} measurement deviations (median)"
    yield PartFinding("model against stand_in", "note" if median[worst] > _FAR_OFF else "fine", notice)


def _nothing_perceived(drive: _Drive) -> PartFinding:
    """Checks that there is a barrier without obstacles; without any barrier the filter always takes the backup."""
    barriers = drive.scene.of(replace(drive.states[0], obstacles=()))
    if isinstance(barriers, str):
        return PartFinding("barriers", "note", f"without obstacles: {barriers}; the backup acts then")
    if not barriers.names:
        return PartFinding(
            "barriers", "wrong", "none without obstacles, where the backup would act forever; add a limit"
        )
    return PartFinding("barriers", "fine", f"{len(barriers.names)} without obstacles")


def _probed(robot: Robot, drive: _Drive) -> Iterator[PartFinding]:
    latent = drive.model.latent if drive.model.latent_names else None
    notice: dict[str, str] = {}
    remarks: dict[str, None] = {}
    for message in drive.states[:: max(1, len(drive.states) // _PROBED)]:
        barriers = drive.scene.of(message)
        if isinstance(barriers, str) or not barriers.names:
            continue
        report = check_filter(
            FilterSession(drive.filter),  # the services decide through one
            message.values,
            barriers=barriers,
            latent=latent,
            can_stop=robot.can_stop,
            ticks=20,
        )
        for issue in report:
            notice.setdefault(issue.subject, str(issue))
        remarks.update(dict.fromkeys(report.notes))
    for sentence in notice.values():
        yield PartFinding("filter", "wrong", sentence)
    for remark in remarks:
        yield PartFinding("filter", "note", remark.removeprefix("Note "))


def _nominal_part(model: PhysicsModel, drive: _Drive) -> PartFinding:
    """Checks the default controller at a visited state."""
    answer = _tried(
        "controllers",
        lambda: controller_for(model)().nominal_action(drive.states[0], model.latent if model.latent_names else None),
    )
    if not isinstance(answer, tuple) or len(answer) != 2 or not isinstance(answer[1], str):
        return PartFinding(
            "controllers", "wrong", f"nominal_action() returned {answer!r}, wanted the action and a name"
        )
    nominal, name = answer
    try:
        numbers = checked_output("nominal", nominal)
    except InputError as error:
        return PartFinding("controllers", "wrong", str(error))
    if numbers.shape != (len(model.system.action),) or not np.isfinite(numbers).all():
        return PartFinding(
            "controllers", "wrong", f"'{name}' returned {nominal}, wanted {len(model.system.action)} numbers"
        )
    return PartFinding("controllers", "fine", f"'{name}' returned {tuple(round(float(entry), 3) for entry in nominal)}")


def _drawing(robot: Robot, drive: _Drive) -> PartFinding:
    shapes = _tried("draw", lambda: dict(robot.draw(drive.states[0])))
    if not shapes:
        return PartFinding("draw", "note", "no shapes; the dashboard shows curves only")
    foreign = [name for name, shape in shapes.items() if not isinstance(shape, (Discs, Lines, Rings))]
    if foreign:
        return PartFinding("draw", "wrong", f"'{foreign[0]}' is none of Discs, Lines, Rings (safedpa.drawing)")
    return PartFinding("draw", "fine", ", ".join(shapes))
