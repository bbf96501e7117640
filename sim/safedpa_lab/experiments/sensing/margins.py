"""Margins of laser perception, calibrated on whole drives with noise, age, lost rays and wrong odometry.

What counts is ``sensing_scores``: by how much the least h of the reported scene exceeds that of the true one. As other
margins it is calibrated over drives, which are exchangeable, and counted on drives with seeds of their own. A drive is
one scene with its people, one load, and one odometry that is wrong by a share of each metre and of each turn.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.calibration.from_drives import calibration_from_drives, covered_shares
from safedpa.dynamics import PhysicsModel, fingerprint, load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.dynamics.limits import IS_STATIONARY
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.margins.error_clipping import NO_CLIP, HSample
from safedpa_lab.experiments.common.drives import PERIOD, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import coverage_row
from safedpa_lab.experiments.common.workers import driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table, page, share_percent
from safedpa_lab.experiments.sensing.experiment import LOADS
from safedpa_lab.experiments.sensing.scenes import scene_and_people
from safedpa_lab.experiments.sensing.scores import NEAR, Misjudges, Score, Scores
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

SCENES: Final = ("people", "rooms", "steps-out")
"""Six pillars among three people; two rooms with a door, boxes and up to six people; someone behind a box."""
ODOMETRY: Final = 0.02
"""Share of each metre, and of each turn, by which a drive's odometry is wrong at most; as perception's ``drift``."""
_WORST: Final = 5
_STOOD: Final = "stood"
"""The kind that no margin is made for."""


@dataclass(frozen=True)
class SensedDrive:
    """One drive, all of whose numbers follow from these."""

    scene: str
    seed: int
    load: str
    seconds: float
    stretch: float
    turning: float
    """Wrong shares of the odometry, see ``Misjudges``."""


def order(index: int, seed: int, seconds: float, scenes: Sequence[str] = SCENES) -> SensedDrive:
    """The drive of a seed: every scene with every load in turn."""
    stretch, turning = np.random.default_rng([seed, 31]).uniform(-ODOMETRY, ODOMETRY, 2).tolist()
    load = LOADS[index // len(scenes) % len(LOADS)]
    return SensedDrive(scenes[index % len(scenes)], seed, load, seconds, stretch, turning)


def run_sensed(wanted: SensedDrive) -> dict[str, Any]:
    """Drives it behind the filter as it ships; the same drive gives the same numbers."""
    model, settings = load_model("car"), settings_named("car")
    scene, people = scene_and_people(wanted.scene, wanted.seed, wanted.load)
    car = CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings(), wanted.seed),), people))
    robot = Misjudges(car, wanted.stretch, wanted.turning)
    sensing = PerceptionSettings()
    scores = Scores(robot, people, settings, sensing)
    nodes = shipped_nodes(model, settings, PerceptionNode(sensing), PolicyNode(model, "way_seeker"))
    for tick in drive(robot, nodes, round(wanted.seconds / PERIOD), hear=scores.hear):
        scores.after(tick)
    return {
        **asdict(wanted),
        "moving": [str(hit) for hit in car.collisions if hit.speed >= IS_STATIONARY],
        "goals": car.goals_reached,
        "scores": [list(one) for one in scores.found],
    }


def margins_of_sensing(
    drives: int,
    fresh: int,
    seconds: float,
    coverage: float,
    processes: int = 1,
    on_drive: ReportProgress = silent,
    record: Path | None = None,
    scenes: Sequence[str] = SCENES,
) -> dict[str, Any]:
    """Margins of a step and of a drive from ``drives`` calibration seeds, and what they cover on ``fresh`` ones.

    Drives that ``record`` holds are not driven again. Raises InputError for too few drives, and for a record of others.
    """
    if drives < smallest_sample(coverage):  # before they are driven
        raise InputError(f"drives: got {drives}, wanted at least {smallest_sample(coverage)} for {coverage:g}")
    orders = [
        [order(index, seed, seconds, scenes) for index, seed in enumerate(seeds_for(purpose, count))]
        for purpose, count in (("calibration", drives), ("evaluation", fresh))
    ]
    found = driven(run_sensed, [*orders[0], *orders[1]], processes, on_drive, record)
    before, after = found[:drives], found[drives:]
    model = load_model("car")
    heights = [_heights(one) for one in before]
    if not any(heights):
        raise InputError(f"{drives} drives of {seconds:g} s: in none the car came near anything; wanted longer ones")
    margin = calibration_from_drives(heights, coverage, time.strftime("%Y-%m-%d"), fingerprint(model), NO_CLIP)
    tables = {"step": margin.epsilon, "drive": margin.drive, "in force": _in_force(model)}
    rows = [_row(kind, before, after, tables) for kind in NEAR]
    return {
        "seconds": seconds,
        "coverage": coverage,
        "near": dict(NEAR),
        "odometry": ODOMETRY,
        "scenes": list(scenes),
        "loads": list(LOADS),
        "seeds": {"calibration": _ends(orders[0]), "evaluation": _ends(orders[1])},
        "rows": rows,
        "moving": [f"{_named(one)}: {what}" for one in found for what in one["moving"]],
        "goals": sum(one["goals"] for one in found),
    }


def _in_force(model: PhysicsModel) -> dict[str, float]:
    """By kind the margin that ships."""
    known = margin_for(model)
    epsilon = {**settings_named("car").epsilon, **({} if known is None else known.epsilon)}
    return {kind: epsilon["obstacle" if kind == "obstacle" else "mover"] for kind in NEAR}


def _ends(orders: Sequence[SensedDrive]) -> list[int]:
    return [orders[0].seed, orders[-1].seed] if orders else []


def _named(one: Mapping[str, Any]) -> str:
    return f"{one['scene']}, load {one['load']}, seed {one['seed']}"


def _scores(one: Mapping[str, Any], kind: str) -> list[Score]:
    scores = (Score(*row) for row in one["scores"] if row[0] == kind)
    return [score for score in scores if score.true < NEAR[kind]]


def _error(score: Score) -> float:
    """e [m]; distances beyond ``NEAR`` count as ``NEAR``."""
    return min(score.hoped, NEAR[score.kind]) - score.true


def _out(score: Score) -> float:
    """m by which the true bodies exceed the reported ones, on the side of the car; of what may move as of when it was
    measured."""
    points, movers, hidden = score.apart
    return min(points, movers) if score.kind == "obstacle" else min(movers, hidden) + score.grown


def _heights(one: Mapping[str, Any]) -> dict[str, FloatArray]:
    """By kind (steps, 4), as ``calibration_from_drives`` takes them."""
    found = {
        kind: [HSample(min(s.hoped, NEAR[kind]), s.true) for s in _scores(one, kind)] for kind in NEAR if kind != _STOOD
    }
    return {kind: np.array(rows) for kind, rows in found.items() if rows}


def _row(
    kind: str,
    before: Sequence[Mapping[str, Any]],
    after: Sequence[Mapping[str, Any]],
    tables: Mapping[str, Mapping[str, float]],
) -> dict[str, Any]:
    """What the margins of a kind are, what they cover on fresh drives, and the worst that happened in all."""
    both = [*before, *after]
    heights, scores = [_heights(one) for one in after], [(one, s) for one in both for s in _scores(one, kind)]
    return {
        "kind": kind,
        "steps": len(scores),
        "drives_near": sum(bool(_scores(one, kind)) for one in both),
        "quantiles": _quantiles([_error(score) for _, score in scores]),
        "out": _quantiles([_out(score) for _, score in scores]) if kind in ("obstacle", "mover") else {},
        "step": tables["step"].get(kind),
        "drive": tables["drive"].get(kind),
        "fresh": {
            name: coverage_row(covered_shares(heights, kind, table[kind]), table[kind])
            for name, table in tables.items()
            if heights and kind in tables["step"]
        },
        "worst": list(_worst(scores)),
    }


def _quantiles(values: Sequence[float]) -> dict[str, float]:
    return {f"{share:g}": float(np.quantile(values, share)) for share in (0.5, 0.9, 0.99, 1.0)} if values else {}


def _worst(scores: Sequence[tuple[Mapping[str, Any], Score]]) -> Iterator[dict[str, Any]]:
    """The drives with the largest errors, each with its worst step."""
    by_drive = [
        max(group, key=lambda pair: _error(pair[1])) for _, group in groupby(scores, lambda pair: _named(pair[0]))
    ]
    for one, score in sorted(by_drive, key=lambda pair: -_error(pair[1]))[:_WORST]:
        reported = zip(("points", "movers", "hidden"), score.apart, strict=True)
        yield {
            "drive": _named(one),
            "time": round(score.time, 3),
            "error": _error(score),
            "hoped": score.hoped,
            "true": score.true,
            "speed": score.speed,
            "seen_for": score.seen_for,
            "apart": {name: away for name, away in reported if away < 100.0},
        }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment sensing-margins``."""
    found = with_options(margins_of_sensing, options, on_drive=report_progress)
    return {"experiment": "sensing-margins", **found}


_KINDS: Final = {
    "obstacle": "at rest",
    "mover": "people seen",
    "hidden": "people hidden",
    "model": "the model alone",
    "stood": "people who have stood since they were seen",
}


def margins_page(result: Mapping[str, Any]) -> str:
    """Markdown: the errors, what margins they make and cover, and the worst of them; and the command that made it."""
    seeds, rows = result["seeds"], result["rows"]
    used, fresh = (" to ".join(map(str, seeds[name])) for name in ("calibration", "evaluation"))
    moving = "\n".join(f"- the car moved into something: {what}" for what in result["moving"])
    return page(
        "Margins of laser perception",
        f"Scenes {', '.join(result['scenes'])}, loads {', '.join(result['loads'])} in turn, {result['seconds']:g} s a "
        f"drive, odometry wrong by up to {100.0 * result['odometry']:g} %; seeds {used} to calibrate, {fresh} to "
        "count. Errors in m of h: above 0 where the reported scene is farther away than the true one. Steps count in "
        f"which the car moves and h of what is there is below {result['near']['obstacle']:g} m, of people "
        f"{result['near']['mover']:g} m. Coverage {100.0 * result['coverage']:g} %; intervals: 95 %.",
        result,
        markdown_table(
            "error of | steps (drives) | median | 90 % | 99 % | largest | margin of a step | of a drive "
            "| body outside the reported one: 99 %, largest",
            map(_errors, rows),
        ),
        markdown_table(
            "error of | margin of | m | steps covered, % | drives covered, %",
            (line for row in rows for line in _coverage(row)),
            above="On fresh drives:",
        ),
        markdown_table(
            "error of | drive | s | error | h reported | h true | m/s | seen for, s | to points | to movers "
            "| to hidden",
            (_worst_row(row["kind"], one) for row in rows for one in row["worst"]),
            above="The worst step of the drives with the largest errors; m from the true position to the reported one:",
        ),
        moving,
    )


def _errors(row: Mapping[str, Any]) -> str:
    found = [f"{row['quantiles'][share]:.3f}" if row["quantiles"] else "" for share in ("0.5", "0.9", "0.99", "1")]
    margins = ["" if row[name] is None else f"{row[name]:.3f}" for name in ("step", "drive")]
    out = f"{row['out']['0.99']:.3f}, {row['out']['1']:.3f}" if row["out"] else ""
    return " | ".join([_KINDS[row["kind"]], f"{row['steps']} ({row['drives_near']})", *found, *margins, out])


def _coverage(row: Mapping[str, Any]) -> Iterator[str]:
    for name, one in row["fresh"].items():
        shares = " | ".join(share_percent(one[what], one[f"{what}_95"]) for what in ("steps", "drives"))
        yield f"{_KINDS[row['kind']]} | {name} | {one['epsilon']:.3f} | {shares}"


def _worst_row(kind: str, one: Mapping[str, Any]) -> str:
    away = one["apart"]
    apart = " | ".join(f"{away[name]:.2f}" if name in away else "" for name in ("points", "movers", "hidden"))
    numbers = [f"{one[name]:.3f}" for name in ("error", "hoped", "true")]
    numbers += [f"{one[name]:.2f}" for name in ("speed", "seen_for")]
    return f"{_KINDS[kind]} | {one['drive']} | {one['time']:g} | {' | '.join(numbers)} | {apart}"
