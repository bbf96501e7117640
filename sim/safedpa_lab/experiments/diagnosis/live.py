"""Live diagnosis, measured: how soon a change is found, named and corrected; and is anything found where nothing is?

In one drive something changes, is found and accepted automatically, and the error falls.
"""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, Final

from safedpa.adaptation import AdaptationNode, LatentEstimator
from safedpa.bus import FINDING, MODEL, STATE, FindingMessage, ModelMessage, ReceivedMessage, Request, StateMessage
from safedpa.calibration.from_runs import live_margin
from safedpa.dynamics import PhysicsModel, load_model, write_model
from safedpa.errors import InputError
from safedpa.live.finding import RobotDiagnosis
from safedpa.live.model_monitor import ALPHA
from safedpa.live.node import DiagnosisNode
from safedpa.live.search_jobs import InlineWorker, WorkOutcome, named_candidate
from safedpa.policy import PolicyNode
from safedpa.records.run import Run
from safedpa.records.writers.mcap import McapRecorder
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_text
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot, PlannedChange
from safedpa_sim.robots.car.scene import Scene

CASES: Final = {"hitch": "towed_load", "headwind": "constant_force", "steering_offset": "steering_offset"}
"""What changes, and the effect of the library that says so."""
MODEL_NAME: Final = "car_measured"
"""The car without a load, nothing of it free: a model whose free parameters are a load's would adapt to the chair."""

_PERIOD: Final = 0.05
_ROBOT: Final = "r1"
_SETTINGS: Final = "car"
_GOALS = 400
_FALL: Final = 0.4
"""Of the error before, to which it has to fall."""
_SEARCHES: Final = 2
"""So many are awaited while the data cannot tell the first effect from another one, as a patient engineer would."""


@dataclass
class LiveDrive:
    """What became of a drive; times in s by the robot's clock, None for what did not happen."""

    case: str
    seed: int
    changed: float | None = None
    raised: float | None = None
    found: float | None = None
    """End of the first search that named the first effect."""
    effect: str = ""
    """Named first."""
    group: tuple[str, ...] = ()
    """What the data cannot tell from it."""
    numbers: dict[str, float] = field(default_factory=dict)
    where: str = ""
    taken: float | None = None
    before: float = 0.0
    """Mean of the live error, sampled once a second, from the finding to the change of the model."""
    after: float | None = None
    """Mean of the live error from 10 to 20 s after the change of the model."""
    fell: float | None = None
    """When the live error of five seconds with the new model was first below 40 % of that before."""
    findings: int = 0
    evidence: float = 0.0
    """Largest."""
    collisions: int = 0
    least_h: float = float("inf")
    goals: int = 0
    driven: float = 0.0
    """s until the end."""


def live_scene(seed: int) -> Scene:
    """The scene of a seed with passages wide enough for a chair, which the car does not tow yet."""
    scene = Scene.random(seed, "chair")
    return dataclasses.replace(scene, load=None, fixed_goals=tuple(itertools.islice(scene.goals(), _GOALS)))


def drive_live(
    case: str,
    seed: int,
    seconds: float,
    after: float = 30.0,
    *,
    model: str = MODEL_NAME,
    hear: Callable[[ReceivedMessage], None] | None = None,
    reading: float = 0.0,
    period: float = _PERIOD,
) -> LiveDrive:
    """Drives until ``seconds``, or until 25 s after the model was changed; the case's change comes ``after`` [s].

    ``case`` is one of ``CASES`` or ``nothing``; ``reading`` [s] goes by before a candidate is accepted; the robot's
    ``period`` [s] need not be its model's. In lockstep, all in one process: the same drive repeats bit for bit.
    """
    loaded = load_model(model)
    change = None if case == "nothing" else PlannedChange(case, after)
    robot = CarRobot(live_scene(seed), period, change=change)
    diagnosis, nodes = _nodes(loaded)
    found = LiveDrive(case, seed)
    notes = _Notes(found, diagnosis, reading, period)

    def listen(item: ReceivedMessage) -> None:
        notes.hear(item)
        if hear is not None:
            hear(item)

    for tick in drive(robot, nodes, round(seconds / period), hear=listen):
        found.least_h = min(found.least_h, tick.verdict.h_now)
        found.changed = None if robot.changed_at is None else robot.changed_at * period
        if found.taken is not None and tick.state.robot_time > found.taken + 25.0:
            break
    found.collisions, found.goals, found.driven = len(robot.collisions), robot.goals_reached, robot.tick * period
    return found


def _nodes(model: PhysicsModel) -> tuple[DiagnosisNode, list[Any]]:
    settings, margin = settings_named(_SETTINGS), margin_for(model)
    text = "" if margin is None else margin_text(margin)
    diagnosis = DiagnosisNode(write_model(model), InlineWorker(_calibrated), text)
    return diagnosis, [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings, margin), diagnosis]


def _calibrated(model: PhysicsModel, run: Run, footprint: tuple[float, ...]) -> str:
    along = (lambda: LatentEstimator(model)) if model.latent_names else None
    return live_margin(model, settings_named(_SETTINGS), run, footprint, along)


class _Notes:
    """Takes down what the findings say, and accepts the first effect that is confirmed."""

    def __init__(self, found: LiveDrive, node: DiagnosisNode, reading: float, period: float = _PERIOD) -> None:
        self._found, self._reading, self._period = found, reading, period
        self._node = node
        self._errors: list[float] = []
        self._later: list[float] = []
        self._seen: WorkOutcome | None = None
        self._shown: tuple[WorkOutcome | None, float] = (None, 0.0)
        """The newest outcome, and the robot's time when it was first there."""
        self._searches = 0

    def hear(self, item: ReceivedMessage) -> None:
        message = item.message
        if item.topic is FINDING and isinstance(message, FindingMessage):
            self._finding(message)
        elif item.topic is MODEL and isinstance(message, ModelMessage) and message.step == "take":
            if self._found.taken is None:
                self._found.taken = message.from_tick * self._period
        elif item.topic is STATE and isinstance(message, StateMessage):
            self._accept(message.robot_time)

    def _finding(self, message: FindingMessage) -> None:
        found = self._found
        found.findings = max(found.findings, message.number)
        found.evidence = max(found.evidence, message.evidence)
        if found.raised is None and message.number > 0:
            found.raised = message.robot_time
        if found.taken is None and message.stage in ("raised", "searching", "candidates", "nothing"):
            self._errors.append(message.error)
            found.before, found.where = sum(self._errors) / len(self._errors), message.where
        elif found.taken is not None:
            self._after(message, message.robot_time - found.taken)

    def _after(self, message: FindingMessage, seconds: float) -> None:
        """Takes down the error after the change of the model, once a whole stretch was driven with it."""
        found = self._found
        if seconds >= 5.0 and found.fell is None and message.error < _FALL * found.before:
            found.fell = message.robot_time
        if 10.0 <= seconds <= 20.0:
            self._later.append(message.error)
            found.after = sum(self._later) / len(self._later)

    def _accept(self, now: float) -> None:
        diagnosis = self._node.diagnosis_of(_ROBOT)
        outcome = None if diagnosis is None else diagnosis.outcome
        if diagnosis is None or outcome is None or outcome is self._seen:
            return
        if self._shown[0] is not outcome:
            self._shown = outcome, now
        if now < self._shown[1] + self._reading:
            return
        self._seen = outcome
        self._searches += 1
        if not outcome.documents or self._found.taken is not None:
            return
        effect, report = outcome.effects[0], json.loads(outcome.report)
        self._take_down(diagnosis, effect, report)
        if not self._worth_it(effect, report) or (self._found.group and self._searches < _SEARCHES):
            return  # the next search has twice the data
        request = Request(
            do="accept", effect=effect, model=diagnosis.fingerprint, finding=diagnosis.number, who="experiment"
        )
        self._node.answer(_ROBOT, request)

    @staticmethod
    def _worth_it(effect: str, report: dict[str, Any]) -> bool:
        """Whether unseen data confirm the required reduction of the error."""
        own = named_candidate(report["candidates"], effect)
        before: float | None = report["stages"][0]["heldout_error"]
        after: float | None = None if own is None else own["heldout_error"]
        return before is not None and after is not None and after < _FALL * before

    def _take_down(self, diagnosis: RobotDiagnosis, effect: str, report: dict[str, Any]) -> None:
        found = self._found
        if effect != found.effect:
            found.found, found.effect = diagnosis.time, effect
        own = named_candidate(report["candidates"], effect)
        if own is not None:
            found.group = tuple(own["indistinguishable_from"])
            found.numbers = {name: value["value"] for name, value in own["parameters"].items()}


_READING = 5.0
"""s."""
_BEGIN = 1_700_000_000 * 10**9
"""ns since 1970 at which the recording's clock begins: the same drive gives the same times."""


def record_drive(case: str, seed: int, seconds: float, after: float, path: Path) -> LiveDrive:
    """Drives as ``drive_live`` does and writes every message; log times follow the robot's clock.

    A person who looks at it later reads the candidates for some seconds, so it takes these before it accepts.
    """
    with McapRecorder(path) as recorder:

        def write(item: ReceivedMessage) -> None:
            at = _BEGIN + round(1e9 * item.message.robot_time)
            recorder.write(item.key, item.payload, at, at)

        return drive_live(case, seed, seconds, after, hear=write, reading=_READING)


NOTHING: Final = "nothing"
_RAISED, _NAMED, _FELL = 10.0, 60.0, 20.0
"""s from the change to the finding and to the effect, and from the model's change to the fallen error."""
_LONGEST = 150.0
"""s of a drive in which something changes."""


@dataclass(frozen=True)
class LiveExperiment:
    """Which cases, on how many scenes each, and how long without any change."""

    cases: tuple[str, ...] = (*CASES, NOTHING)
    seeds: tuple[int, ...] = tuple(range(1, 11))
    quiet_seeds: tuple[int, ...] = (1,)
    quiet_seconds: float = 3600.0
    change_after: float = 30.0
    processes: int = 1
    model: str = MODEL_NAME


def live_experiment(experiment: LiveExperiment, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """One row a case with every drive in it, and the drives in which nothing changed."""
    jobs = [(case, seed, _LONGEST) for case in experiment.cases if case != NOTHING for seed in experiment.seeds]
    if NOTHING in experiment.cases:
        jobs += [(NOTHING, seed, experiment.quiet_seconds) for seed in experiment.quiet_seeds]
    run_one = partial(_run, experiment.change_after, experiment.model)
    drives = each_result(run_one, jobs, experiment.processes, report_progress)
    rows = [_row(case, [item for item in drives if item.case == case]) for case in experiment.cases if case != NOTHING]
    quiet = [item for item in drives if item.case == NOTHING]
    return {**dataclasses.asdict(experiment), "rows": rows, "quiet": _quiet(quiet) if quiet else None}


def _run(after: float, model: str, job: tuple[str, int, float]) -> LiveDrive:
    """The same job gives the same drive."""
    return drive_live(*job, after, model=model)


def _row(case: str, drives: Sequence[LiveDrive]) -> dict[str, Any]:
    found = [_judged(item) for item in drives]
    return {
        "case": case,
        "effect": CASES[case],
        "drives": len(found),
        **{
            name: sum(item[name] for item in found)
            for name in ("raised_in_time", "first", "named_in_time", "fell_in_time")
        },
        "collisions": sum(item["collisions"] for item in found),
        **{
            f"{name}_median": _median([item[name] for item in found])
            for name in ("seconds_to_finding", "seconds_to_effect", "seconds_to_fall", "before", "after")
        },
        "each": found,
    }


def _judged(drive: LiveDrive) -> dict[str, Any]:
    """The drive with times counted from the change, and which steps were in time."""
    changed = drive.changed

    def since(moment: float | None, start: float | None) -> float | None:
        return None if moment is None or start is None else round(moment - start, 3)

    to_finding, to_effect = since(drive.raised, changed), since(drive.found, changed)
    to_fall = since(drive.fell, drive.taken)
    right = CASES[drive.case]
    return {
        **dataclasses.asdict(drive),
        "seconds_to_finding": to_finding,
        "seconds_to_effect": to_effect,
        "seconds_to_fall": to_fall,
        "raised_in_time": to_finding is not None and 0.0 <= to_finding <= _RAISED,
        "first": drive.effect == right,
        "named_in_time": to_effect is not None and 0.0 <= to_effect <= _NAMED and right in (drive.effect, *drive.group),
        "fell_in_time": to_fall is not None and to_fall <= _FELL,
    }


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return round(median(known), 4) if known else None


def _quiet(drives: Sequence[LiveDrive]) -> dict[str, Any]:
    hours = sum(item.driven for item in drives) / 3600.0
    return {
        "hours": round(hours, 3),
        "findings": sum(item.findings for item in drives),
        "stated_probability_at_most": round(min(1.0, ALPHA * 3600.0 * hours), 6),
        "largest_evidence": round(max(item.evidence for item in drives), 2),
        "collisions": sum(item.collisions for item in drives),
        "each": [dataclasses.asdict(item) for item in drives],
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment live``, or records one of its drives."""
    case, after, record = options["case"], options["after"], options["record"]
    if not 25.0 <= after < 1e5:
        raise InputError("--after: wanted 25 s or more, the band is learned in the first 20 s")
    if record is not None:
        if case == "all":
            raise InputError("--record: got --case all, wanted one case; a recording holds one drive")
        drive = record_drive(case, options["seed"], 120.0 + after, after, record)
        return {"experiment": "live", "recording": str(record), **dataclasses.asdict(drive)}
    first, quiet = options["seed"], options["quiet_drives"]
    experiment = LiveExperiment(
        cases=(*CASES, NOTHING) if case == "all" else (case,),
        seeds=tuple(range(first, first + options["drives"])),
        quiet_seeds=tuple(range(first, first + quiet)),
        quiet_seconds=3600.0 * options["hours"] / quiet,
        change_after=after,
        processes=options["processes"],
    )
    return {"experiment": "live", **live_experiment(experiment, report_progress)}


def report(result: Result) -> str:
    """One row per change, and the findings while nothing changed."""
    if "recording" in result:
        return f"recording: {result['recording']}"
    parts = []
    if result["rows"]:
        above = f"The change comes after {result['change_after']:g} s; medians in s, errors over 1 s."
        head = "case | raised | after | named | after | first | error | then | fell | hits"
        parts.append(markdown_table(head, map(_row_text, result["rows"]), above=above))
    if (quiet := result["quiet"]) is not None:
        parts.append(
            f"Nothing changed in {quiet['hours']:g} h: {quiet['findings']} findings (stated: any with probability "
            f"{quiet['stated_probability_at_most']:.2%} at most), {quiet['collisions']} collisions."
        )
    return "\n\n".join(parts)


def _row_text(row: dict[str, Any]) -> str:
    def number(name: str, digits: int) -> str:
        value = row[f"{name}_median"]
        return "" if value is None else f"{value:.{digits}f}"

    count = row["drives"]
    return (
        f"{row['case']} | {row['raised_in_time']}/{count} | {number('seconds_to_finding', 1)} "
        f"| {row['named_in_time']}/{count} | {number('seconds_to_effect', 1)} | {row['first']}/{count} "
        f"| {number('before', 3)} | {number('after', 3)} | {row['fell_in_time']}/{count} | {row['collisions']}"
    )
