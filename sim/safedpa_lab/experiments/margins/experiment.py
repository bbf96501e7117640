"""The margins that ship, and how often they hold on fresh drives: made and counted by one command.

For each robot and model in two rounds, since errors depend on where the filter lets the robot go: drives behind the
filter with the margin that its settings assume make first margins, of a step and of a whole drive. Other drives behind
the first margin of a step make the one that ships, and as many behind that of a drive likewise. What ships now decides
nothing, so the same command makes the same margins again. Drives on evaluation seeds behind the filter with the new
margin tell how many steps and how many drives it covered, and how many goals each kind of margin costs. Drives are kept
as they are made, so that a run may be cut anywhere and gone on with.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.calibration.from_drives import calibration_from_drives, covered_shares
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import check_archive
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa.safety.margins.conformal import smallest_sample
from safedpa.safety.margins.error_clipping import ErrorClip
from safedpa_lab.experiments.common.drives import statuses_of
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import coverage_row, mean_interval
from safedpa_lab.experiments.common.workers import Progress, Workers
from safedpa_lab.experiments.margins.drives import DRIVERS, DriveOrder, DriveResult, driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import interval, made_by, markdown_table, share_percent
from safedpa_lab.theory.boundary_layer import Stay, stays_in_layer

KINDS = ("conformal", "drive")
"""Margins of a step and of a whole drive."""
SHIPPED = "shipped"
"""The margin that ships now, to hold the new ones against."""


_COVERAGE: Final = 0.99


@final
@dataclass(frozen=True)
class MarginCases:
    """What is to be made. Raises InputError for numbers out of range."""

    robots: tuple[str, ...]
    out: Path
    drives: int = 200
    """On calibration seeds, for each of ``KINDS``; 99 at least for a coverage of 99 %. Half as many, but no fewer than
    that, go before. 0: none is made, and what ships, a margin or the one that the settings assume, is counted alone."""
    fresh: int = 200
    """On evaluation seeds, for each kind of margin."""
    skip: int = 0
    """Evaluation seeds that are left out, since something was chosen on them."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of margin behind which fresh drives are made; of ``KINDS`` or ``SHIPPED``."""
    seconds: float = 0.0
    """Of a drive; 0: as each robot has it."""
    coverage: float = _COVERAGE
    processes: int = 2
    minutes: float = 0.0
    """After which no new drive begins; 0: until all is done."""

    def __post_init__(self) -> None:
        for name in self.robots:
            if name not in DRIVERS:
                raise InputError(f"--robot '{name}': {did_you_mean(name, DRIVERS)}")
        for kind in self.kinds:
            if kind not in (known := (*KINDS, SHIPPED)):
                raise InputError(f"--kind '{kind}': {did_you_mean(kind, known)}")
        if self.processes < 1 or (self.drives < 1 and (self.drives < 0 or self.kinds != (SHIPPED,))):
            raise InputError("--drives and --processes: wanted more than 0, or --drives 0 --kind shipped")
        if min(self.fresh, self.skip, self.seconds, self.minutes) < 0:
            raise InputError("--fresh, --skip, --seconds, --minutes: wanted 0 or more")

    @property
    def first(self) -> int:
        """Drives of the first round."""
        return max(smallest_sample(self.coverage), self.drives // 2)

    @property
    def total(self) -> int:
        """Drives of one robot."""
        if not self.drives:
            return self.fresh
        return self.first + len(KINDS) * self.drives + len(self.kinds) * self.fresh


def margins_experiment(cases: MarginCases, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """One entry a robot: its margins once they are there, what they covered; ``missing`` drives where time ran out."""
    ends = time.monotonic() + 60.0 * cases.minutes if cases.minutes else float("inf")
    total = len(cases.robots) * cases.total
    count = Progress(total, report_progress)
    rows = {}
    with Workers(cases.processes) as workers:
        for name in cases.robots:
            rows[name] = _of_robot(cases, name, workers, ends, count)
    return {"experiment": "margins", "coverage": cases.coverage, "robots": rows, "missing": total - count.done}


def _of_robot(cases: MarginCases, name: str, workers: Workers, ends: float, count: Progress) -> dict[str, Any]:
    folder, seconds = cases.out / name, cases.seconds or DRIVERS[name].seconds

    def made(part: str, behind: MarginCalibration | None, kind: str, seeds: range) -> list[DriveResult]:
        orders = [DriveOrder(name, seed, behind, kind, seconds) for seed in seeds]
        return _driven(folder / part, orders, workers, ends, count)

    if not cases.drives:
        fresh = made(f"fresh-{SHIPPED}", _shipped(name), KINDS[0], seeds_for("evaluation", cases.fresh, cases.skip))
        return _shipped_alone(name, fresh, seconds) if fresh else {"drives": 0}
    first = made("first", None, KINDS[0], seeds_for("calibration", cases.first))
    if len(first) < cases.first:
        return {"drives": len(first)}
    plain = cases.coverage * cases.first / (cases.first + 1)
    before = _calibrated(cases, name, seconds, first, "the margin of the settings", plain)
    seeds = seeds_for("calibration", cases.drives, cases.first)
    second = {kind: made(f"calibration-{kind}", before, kind, seeds) for kind in KINDS}
    if any(len(results) < cases.drives for results in second.values()):
        return {"drives": sum(map(len, second.values()))}
    behind = f"a margin of {cases.first} other drives"
    tables = {kind: _calibrated(cases, name, seconds, results, behind) for kind, results in second.items()}
    margin = _joined(tables)
    row: dict[str, Any] = {"drives": cases.drives, "seconds": seconds, "epsilon": margin.epsilon, "drive": margin.drive}
    clip = _clip(name)
    for kind, results in second.items():
        row[f"calibration_{kind}"] = _counted(results, _spoken_of(margin, None, kind), clip)
        row[f"calibration_{kind}"] |= _driving(results, seconds)
    for kind in cases.kinds:
        ahead, which = (margin, kind) if kind in KINDS else (_shipped(name), KINDS[0])
        if fresh := made(f"fresh-{kind}", ahead, which, seeds_for("evaluation", cases.fresh, cases.skip)):
            spoken_of = _spoken_of(margin, ahead, kind)
            row[f"fresh_{kind}"] = _counted(fresh, spoken_of, clip) | _driving(fresh, seconds)
            if kind in spoken_of:
                row[f"fresh_{kind}"]["layer"] = _layers(fresh, seconds, spoken_of[kind], clip.eta)
    _with_the_rest(margin, _shipped(name), row).save(folder / "margin.toml")
    return row


def _shipped(name: str) -> MarginCalibration | None:
    """None: of this one there is only what its settings assume."""
    model = load_model(DRIVERS[name].model)
    shipped, period = margin_for(model), DRIVERS[name].period
    if shipped is None or not period:
        return shipped
    return replace(shipped.for_period(period, model.period)[0], theorem={}, period=period, slower={})


def _shipped_alone(name: str, fresh: Sequence[DriveResult], seconds: float) -> dict[str, Any]:
    """How often the margin that ships, or the one that the settings assume, held on these drives behind it."""
    shipped, clip = _shipped(name), _clip(name)
    table = dict(settings_named(DRIVERS[name].settings).epsilon) if shipped is None else shipped.epsilon
    row = _counted(fresh, {SHIPPED: table}, clip) | _driving(fresh, seconds)
    row["layer"] = _layers(fresh, seconds, table, clip.eta)
    return {"drives": 0, "seconds": seconds, "epsilon": table, "drive": {}, f"fresh_{SHIPPED}": row}


def _with_the_rest(
    margin: MarginCalibration, shipped: MarginCalibration | None, row: dict[str, Any]
) -> MarginCalibration:
    """With the coverage on unseen drives, and with the theorem's bound of this model, which no drive here measures."""
    covered = {
        f"{kind}.{barrier}": counted[kind][share]
        for kind, share in zip(KINDS, ("steps", "drives"), strict=True)
        for barrier, counted in row.get(f"fresh_{kind}", {}).get("covered", {}).items()
    }
    if shipped is None or not shipped.theorem:
        return replace(margin, covered=covered)
    known = {key: value for key, value in shipped.covered.items() if key.startswith("theorem.")}
    bound = {key: value for key, value in shipped.constants.items() if "clip." not in key}
    constants = bound | margin.constants
    return replace(margin, theorem=shipped.theorem, constants=constants, covered=covered | known)


def _joined(tables: Mapping[str, MarginCalibration]) -> MarginCalibration:
    """Each kind of margin from the drives behind its own first one; ``tables`` by kind of margin."""
    step, drive = (tables[kind] for kind in KINDS)
    tops = {key: value for key, value in drive.constants.items() if key.startswith("drive.")}
    return replace(step, drive=drive.drive, constants=step.constants | tops)


def _spoken_of(margin: MarginCalibration, behind: MarginCalibration | None, kind: str) -> dict[str, dict[str, float]]:
    """By kind of margin the tables that are counted on the drives behind one of them."""
    tables = {"conformal": margin.epsilon, "drive": margin.drive}
    if kind not in KINDS and behind is not None:
        tables[kind] = behind.epsilon
    return tables


def _calibrated(
    cases: MarginCases,
    name: str,
    seconds: float,
    made: Sequence[DriveResult],
    behind: str,
    coverage: float | None = None,
) -> MarginCalibration:
    """A ``coverage`` of n / (n + 1) of the requested one gives the plain quantile, without a guarantee."""
    first, last = made[0].seed, made[-1].seed
    asked = f"--drives {cases.drives}" + ("" if cases.coverage == _COVERAGE else f" --coverage {cases.coverage}")
    origin = (
        f"safedpa experiment margins --robot {name} {asked}: seeds {first} to {last}, {seconds:g} s each, "
        f"in lockstep behind {behind}"
    )
    model = load_model(DRIVERS[name].model)
    heights = [item.heights for item in made]
    asked_for = cases.coverage if coverage is None else coverage
    found = calibration_from_drives(
        heights, asked_for, time.strftime("%Y-%m-%d"), fingerprint(model), _clip(name), origin
    )
    return replace(found, period=DRIVERS[name].period or model.period)


def _clip(name: str) -> ErrorClip:
    return ErrorClip.of_settings(settings_named(DRIVERS[name].settings))


def _driven(
    folder: Path, orders: Sequence[DriveOrder], workers: Workers, ends: float, count: Progress
) -> list[DriveResult]:
    """The results of the orders, in order, up to where time ran out. Those that are kept of the same order are read."""
    folder.mkdir(parents=True, exist_ok=True)
    missing = [order for order in orders if not _path(folder, order).exists()]
    count.advance(len(orders) - len(missing))
    in_time = takewhile(lambda _: time.monotonic() <= ends, missing)
    for result, order in zip(workers.map(driven, in_time), missing, strict=False):
        _keep(_path(folder, order), result)
        count.advance(1)
    return [_retained(path) for path in (_path(folder, order) for order in orders) if path.exists()]


def _path(folder: Path, order: DriveOrder) -> Path:
    """One file a drive; another margin is another drive."""
    margin = "none" if order.margin is None else _digest_of(order.margin)
    return folder / f"{order.seed}-{order.seconds:g}s-{margin}.npz"


def _digest_of(margin: MarginCalibration) -> str:
    """A few digits that tell one table of margins from another."""
    import hashlib

    numbers = json.dumps([margin.epsilon, margin.drive], sort_keys=True)
    return hashlib.sha256(numbers.encode()).hexdigest()[:8]


def _keep(path: Path, result: DriveResult) -> None:
    about = {name: value for name, value in vars(result).items() if name != "heights"}
    about["steps"] = {kind: len(values) for kind, values in result.heights.items()}
    whole = path.with_name(f"new-{path.name}")
    heights = np.concatenate([*result.heights.values(), np.zeros((0, 4))])
    np.savez_compressed(whole, about=np.array(json.dumps(about)), heights=heights)
    whole.replace(path)


def _retained(path: Path) -> DriveResult:
    check_archive(path)
    with np.load(path) as table:
        about, heights = json.loads(str(table["about"])), np.array(table["heights"])
    steps = about.pop("steps")
    parts = np.split(heights, np.cumsum(list(steps.values()))[:-1])
    return DriveResult(heights=dict(zip(steps, parts, strict=False)), **about)


def _counted(
    results: Sequence[DriveResult], tables: Mapping[str, Mapping[str, float]], clip: ErrorClip
) -> dict[str, Any]:
    """By kind of barrier: the share of steps that each margin covered, and of drives in which it covered every step."""
    drives = [item.heights for item in results]
    rows: dict[str, Any] = {}
    for kind in next(iter(tables.values())):
        near = sum(len(clip.errors(kind, heights[kind])) > 0 for heights in drives if kind in heights)
        rows[kind] = {"drives": len(drives), "drives_near": near}
        for name, table in tables.items():
            rows[kind][name] = coverage_row(covered_shares(drives, kind, table[kind], clip), table[kind])
    return {"covered": rows}


def _driving(results: Sequence[DriveResult], seconds: float) -> dict[str, Any]:
    goals = np.array([60.0 * item.goals / seconds for item in results])
    return {
        "drives": len(results),
        "collisions": sum(item.collisions for item in results),
        "goals": sum(item.goals for item in results),
        "goals_a_minute": mean_interval(goals),
        "statuses": statuses_of(item.statuses for item in results),
        "least_h": min(item.least_h for item in results),
    }


def _layers(
    results: Sequence[DriveResult], seconds: float, epsilon: Mapping[str, float], eta: float
) -> dict[str, dict[str, float]]:
    """By kind of barrier: the stays of its least h in its boundary layer 0 <= h < epsilon / eta, over all drives."""
    rows: dict[str, dict[str, float]] = {}
    for kind, margin in epsilon.items():
        stays: list[tuple[Stay, float]] = []
        for item in results:
            hoped, measured = item.heights.get(kind, np.zeros((0, 4))).T[:2].tolist()
            found = stays_in_layer(measured[:-1], hoped[1:], [margin / eta] * len(hoped[1:]))
            stays += [(stay, stay.ticks * seconds / item.ticks) for stay in found]
        rows[kind] = {
            "depth": margin / eta,
            "stays": len(stays),
            "longest_seconds": max((length for _, length in stays), default=0.0),
            "fall": max((stay.fall for stay, _ in stays), default=0.0),
            "errors": max((stay.errors for stay, _ in stays), default=0.0),
            "least_rise": min((stay.least_rise for stay, _ in stays), default=0.0),
        }
    return rows


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment margins``."""
    robots = options["robots"] or tuple(DRIVERS)
    return margins_experiment(with_options(MarginCases, options, robots=robots), report_progress)


_NAMES = {"conformal": "step", "drive": "drive", "shipped": "shipped"}


def margins_page(result: dict[str, Any]) -> str:
    """Markdown tables of a result, without those of robots that are not done."""
    coverage, driving, layers = [], [], []
    for name, kind, fresh in _fresh(result):
        for barrier, counts in fresh["covered"].items():
            if kind in counts:  # else nothing shipped covers this one
                coverage.append(_coverage(f"{name} | {barrier} | {_NAMES[kind]}", counts, counts[kind]))
        statuses = ", ".join(f"{status} {count}" for status, count in fresh["statuses"].items())
        goals = interval(fresh["goals_a_minute"], digits=2)
        counted = f"{fresh['collisions']} | {fresh['least_h']:.4f} | {statuses}"
        driving.append(f"{name} | {_NAMES[kind]} | {goals} | {counted}")
        for barrier, of in fresh.get("layer", {}).items():
            layers.append(
                f"{name} | {barrier} | {_NAMES[kind]} | {of['depth']:.4f} | {of['stays']} "
                f"| {of['longest_seconds']:.2f} | {of['fall']:.4f} | {of['errors']:.4f} | {of['least_rise']:.4f}"
            )
    blocks = [
        f"{made_by(result)}; coverage {100 * result['coverage']:g} %; intervals: 95 %.",
        markdown_table(
            "robot | barrier | margin of a | epsilon | steps covered, % | drives covered, % | fresh drives (near)",
            coverage,
        ),
        markdown_table("robot | margin of a | goals a minute | collisions | least h | verdicts", driving),
        markdown_table(
            "robot | barrier | margin of a | depth of the boundary layer | stays in it | longest, s | h fell by at "
            "most | errors of one stay | least rise promised",
            layers,
        ),
    ]
    if result.get("missing"):
        blocks.append(f"{result['missing']} drives are missing; run the same command again to continue.")
    return "\n\n".join(blocks) + "\n"


def _coverage(names: str, counts: dict[str, Any], one: dict[str, Any]) -> str:
    shares = " | ".join(share_percent(one[what], one[f"{what}_95"]) for what in ("steps", "drives"))
    return f"{names} | {one['epsilon']:.4f} | {shares} | {counts['drives']} ({counts['drives_near']})"


def _fresh(result: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    rows = result["robots"].items()
    return [(name, kind, row[f"fresh_{kind}"]) for name, row in rows for kind in _NAMES if f"fresh_{kind}" in row]
