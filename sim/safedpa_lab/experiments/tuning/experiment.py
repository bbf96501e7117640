"""The tuning of the car's networks, and its honest comparison: every model, metric and load on the same fresh drives.

Reality is the pymunk car. Models are tuned on circles without load, or online: on two minutes that the robot drives
with the very load, judged on other drives with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import click
import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError, did_you_mean
from safedpa_lab.experiments.car.conditions import CONFIGURATIONS
from safedpa_lab.experiments.car.drives import DriveOrder, cut_at_contact, recorded_drive
from safedpa_lab.experiments.car.predictor import OWN_STATES
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.experiments.tuning.errors import HORIZONS, METRICS, errors_of_drive, metrics_of, ratios_of
from safedpa_lab.experiments.tuning.models import ROWS, Retained, TunedModels, key_of
from safedpa_lab.experiments.tuning.real_car import RealTuning, real_tuning
from safedpa_lab.provenance.code import without_text
from safedpa_lab.tuning.online import OnlineTuning, tuned_online
from safedpa_lab.tuning.predictors import AbstractPredictor
from safedpa_sim.training.data.recorded_runs import TuningDrive

LOADS: Final = ("none", *(load for load in CONFIGURATIONS if load != "none"))
BASES: Final = ("untuned", "untuned_point")
"""What every row is compared with."""
DEVELOPMENT: Final = ((40_000, 40_003), (41_000, 41_001), (1_050_000, 1_050_001), (2_050_000, 2_050_009))
"""First and last seeds of the drives on which the settings of online and residual tuning were chosen."""
_SKIP: Final = 60_000
"""Seeds of each purpose before those of this experiment."""
_A_SEED: Final = 100
_SEEDS: Final = 300
"""Valid seeds."""
_OWN: Final = 2
"""Drives with its load that a robot tunes itself on."""
_MEASURE: Final = without_text(Path(__file__).with_name("errors.py").read_text(encoding="utf-8"))
"""What errors are: part of the key under which they are kept."""


@dataclass(frozen=True)
class CarTuning:
    """What to measure. Raises InputError naming what does not fit."""

    models: Path
    out: Path | None = None
    """Folder of models, drives and errors, so that an interrupted run continues."""
    seed: int = 0
    drives: int = 10
    """Fresh drives with each load."""
    ticks: int = 400
    own_ticks: int = 1200
    """Of each of the two drives that a robot tunes itself on; a minute."""
    rows: tuple[str, ...] = tuple(ROWS)
    small: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.seed < _SEEDS:
            raise InputError(f"seed: got {self.seed}, wanted 0 to {_SEEDS - 1}")
        if not 2 <= self.drives <= _A_SEED:
            raise InputError(f"drives: got {self.drives}, wanted 2 to {_A_SEED}")
        if self.ticks < 100 or self.own_ticks < 320:
            raise InputError(f"ticks: got {self.ticks} and {self.own_ticks}, wanted at least 100 and, of its own, 320")
        for row in self.rows:
            if row not in ROWS:
                raise InputError(f"row '{row}': {did_you_mean(row, ROWS)}")


def car_tuning(experiment: CarTuning, report_progress: Callable[[str], None] = lambda _what: None) -> dict[str, Any]:
    """Metrics by row, load and horizon, and their ratios to both untuned rows. The same seed gives the same figures."""
    retained = Retained(None if experiment.out is None else experiment.out / "retained")
    models = TunedModels(experiment.models, retained, experiment.seed, experiment.small, report_progress)
    scale = models.untuned["increment_scale"].astype(np.float64)
    fresh = seeds_for("evaluation", experiment.drives, _SKIP + _A_SEED * experiment.seed)
    own = seeds_for("calibration", _OWN, _SKIP + _A_SEED * experiment.seed)
    run = _Run(experiment, models, retained, report_progress)
    names = tuple(dict.fromkeys((*BASES, *experiment.rows)))
    errors = {}
    for name in names:
        report_progress(ROWS[name])
        errors[name] = run.errors(name, fresh, own, torch.from_numpy(scale).float())
    return {
        "increment_scale": scale.tolist(),
        "seeds": {
            "fresh": [fresh[0], fresh[-1]],
            "own": [own[0], own[-1]],
            "development": [list(pair) for pair in DEVELOPMENT],
        },
        "drives": {"ticks": experiment.ticks, "own_ticks": experiment.own_ticks, "each": experiment.drives},
        "online": asdict(OnlineTuning()),
        "rows": {
            name: {
                "title": ROWS[name],
                "refused": models.refusal(name),
                **_figures(errors, name, scale),
                **_taken(errors[name]),
            }
            for name in names
        },
    }


@dataclass
class _Run:
    experiment: CarTuning
    models: TunedModels
    retained: Retained
    report_progress: Callable[[str], None]

    def errors(self, row: str, fresh: Sequence[int], own: Sequence[int], scale: torch.Tensor) -> dict[str, Any]:
        """By load: the errors of each fresh drive, and for a row tuned online what was taken."""
        found: dict[str, Any] = {}
        base = self._base(row)
        for load in LOADS:
            drives = [self._drive(seed, load, self.experiment.ticks) for seed in fresh]
            learned: list[TuningDrive] = []
            if row.startswith("online_"):
                learned = [self._drive(seed, load, self.experiment.own_ticks) for seed in own]
            key = key_of(__name__, _MEASURE, *_reported(base), *_digests([*drives, *learned]), row)
            found[load] = self.retained.table(f"{row}-{load}", key, partial(_measured, base, drives, learned, scale))
        return found

    def _base(self, row: str) -> AbstractPredictor:
        begun = {"online_untuned": "at_axle", "online_tuned": "tuned_point"}
        return self.models.predictor(begun.get(row, row.removeprefix("online_")))

    def _drive(self, seed: int, load: str, ticks: int) -> TuningDrive:
        def make() -> tuple[FloatArray, ...]:
            drive = cut_at_contact(recorded_drive(DriveOrder(seed, load, ticks)))
            return drive.states, drive.actions

        key = key_of("safedpa_lab.experiments.car.drives", seed, load, ticks)
        return TuningDrive(*self.retained.arrays(f"drive-{load}-{seed}", key, make))


def _measured(
    base: AbstractPredictor, drives: Sequence[TuningDrive], own: Sequence[TuningDrive], scale: torch.Tensor
) -> dict[str, Any]:
    """Errors of each drive by the base, or by what it becomes by tuning on the robot's own drives."""
    if not own:
        return {"drives": [errors_of_drive(base, drive) for drive in drives]}
    tuned, taken = tuned_online(base, own, scale)
    errors = [errors_of_drive(tuned, drive) for drive in drives]
    return {"drives": errors, "taken": {**asdict(taken), "refused": taken.refused}}


def _figures(errors: dict[str, Any], name: str, scale: FloatArray) -> dict[str, Any]:
    """Metrics and ratios by load and horizon; ``loads`` are the three loads together, ``mixed`` all."""
    groups = {**{load: (load,) for load in LOADS}, "loads": LOADS[1:], "mixed": LOADS}
    figures: dict[str, Any] = {"metrics": {}, "ratios": {}}
    for group, loads in groups.items():
        figures["metrics"][group], figures["ratios"][group] = {}, {}
        for horizon in HORIZONS:
            paired = {row: _paired(errors[row], loads, horizon) for row in (name, *BASES)}
            flat = [drive for group_ in paired[name] for drive in group_]
            figures["metrics"][group][horizon] = metrics_of(flat, scale)
            figures["ratios"][group][horizon] = {
                base: ratios_of(paired[base], paired[name], scale) for base in BASES if base != name
            }
    return figures


def _paired(errors: dict[str, Any], loads: Sequence[str], horizon: str) -> list[list[dict[str, Any]]]:
    """For each seed, its drives with the loads."""
    columns = [[drive[horizon] for drive in errors[load]["drives"]] for load in loads]
    return [list(drives) for drives in zip(*columns, strict=True)]


def _taken(errors: dict[str, Any]) -> dict[str, Any]:
    found = {load: row["taken"] for load, row in errors.items() if "taken" in row}
    return {"taken": found} if found else {}


def _reported(predictor: AbstractPredictor) -> list[str]:
    """Numbers of the networks, and what else shapes a prediction, as text."""
    parts = (*predictor.networks.state_dict().values(), *predictor.encoder.state_dict().values())
    point = getattr(predictor, "point", None)
    return [type(predictor).__name__, str(point), *_digests([tuple(part.numpy() for part in parts)])]


def _digests(groups: Sequence[tuple[NDArray[Any], ...]]) -> list[str]:
    from hashlib import sha256

    return [
        sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in group)).hexdigest()[:16] for group in groups
    ]


PARTS = ("car", "real")
"""The car in simulation, and recordings of the real one."""


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment tuning``. Raises InputError for the real car without recordings."""
    del report_progress  # trainings print what they do instead
    parts = options["parts"] or PARTS
    if parts == ("real",) and options["data"] is None:
        raise InputError("--part real: got no --data, wanted the folder with recordings of the real car")
    # Made first: recordings that cannot be used are refused before hours of training.
    real = RealTuning(options["data"], options["out"], options["seed"], options["small"])
    result: Result = {"experiment": "tuning", "seed": options["seed"]}
    if "car" in parts:
        names = ("models", "out", "seed", "drives", "small", *(("rows",) if options["rows"] else ()))
        result["car"] = car_tuning(CarTuning(**{name: options[name] for name in names}), _print)
    if "real" in parts:
        result["real"] = real_tuning(real, _print)
    return result


def _print(what: str) -> None:
    click.echo(f"experiment tuning: {what}", err=True)


_METRICS: Final = {
    "root_mean_square": "Root mean square",
    "mean_square": "Mean square",
    "squared_norm": "Squared norm, raw SI units",
}
_HORIZONS: Final = {"one_step": "one step (0.05 s)", "one_second": "one second"}
_GROUPS: Final = {"none": "without a load", "loads": "with loads", "mixed": "all together"}
_BASES: Final = {"untuned": "as trained", "untuned_point": "at the right point"}
_UNITS: Final = ("mm", "mm", "mrad", "mm/s")


def tuning_page(result: Mapping[str, Any]) -> str:
    """Markdown: every metric and ratio, errors by state, what online tuning took, the real car; and the command."""
    made = result.get("provenance", {})
    lines = ["# Tuning, row by row", "", f"`{made.get('command')}`, {str(made.get('date'))[:10]}", ""]
    if "car" in result:
        lines += _car(result["car"])
    if "real" in result:
        lines += _real(result["real"])
    return "\n".join(lines).rstrip() + "\n"


def _car(car: Mapping[str, Any]) -> list[str]:
    seeds, drives = car["seeds"], car["drives"]
    development = " and ".join(f"{first} to {last}" for first, last in seeds["development"])
    lines = [
        f"Fresh drives: {drives['each']} of {drives['ticks']} periods with each load, seeds {_span(seeds['fresh'])}; a "
        f"robot's own drives, on which it tunes itself online: {drives['own_ticks']} periods each, seeds "
        f"{_span(seeds['own'])}. Settings were chosen on seeds {development}. Ratios: how many times less than the "
        "untuned networks; 95 % intervals over drives, in pairs.",
        "",
    ]
    for metric in METRICS:
        for horizon in HORIZONS:
            lines += [f"## {_METRICS[metric]}, {_HORIZONS[horizon]}", "", _table(car, metric, horizon), ""]
    refused = [f"{row['title']}: {row['refused']}" for row in car["rows"].values() if row["refused"]]
    return [*lines, *_states(car), *_loads(car), *_taken_table(car), *refused]


def _table(car: Mapping[str, Any], metric: str, horizon: str) -> str:
    head = [
        f"{reported}: {word}"
        for reported in _GROUPS.values()
        for word in ("error", *(f"times, {b}" for b in _BASES.values()))
    ]
    rows = []
    for row in car["rows"].values():
        cells = [row["title"]]
        for group in _GROUPS:
            cells.append(f"{row['metrics'][group][horizon][metric]:.3g}")
            ratios = row["ratios"][group][horizon]
            cells += [_ratio(ratios[base][metric]) if base in ratios else "1" for base in _BASES]
        rows.append(" | ".join(cells))
    return markdown_table(" | ".join(["", *head]).strip(), rows)


def _states(car: Mapping[str, Any]) -> list[str]:
    lines = []
    for horizon in HORIZONS:
        head = [
            f"{reported}: {state}, {unit}"
            for reported in ("without a load", "with loads")
            for state, unit in zip(OWN_STATES, _UNITS, strict=True)
        ]
        rows = []
        for row in car["rows"].values():
            found = [row["metrics"][group][horizon][state] for group in ("none", "loads") for state in OWN_STATES]
            rows.append(" | ".join([row["title"], *(_short(1000.0 * value) for value in found)]))
        table = markdown_table(" | ".join(["", *head]).strip(), rows, above="Root mean square.")
        lines += [f"## By state, {_HORIZONS[horizon]}", "", table, ""]
    return lines


def _loads(car: Mapping[str, Any]) -> list[str]:
    loads = [name for name in next(iter(car["rows"].values()))["metrics"] if name not in ("loads", "mixed")]
    lines = []
    for horizon in HORIZONS:
        rows = []
        for row in car["rows"].values():
            cells = [row["title"]]
            for load in loads:
                ratios = row["ratios"][load][horizon]
                times = f" ({_ratio(ratios['untuned']['root_mean_square'])})" if "untuned" in ratios else ""
                cells.append(f"{row['metrics'][load][horizon]['root_mean_square']:.3g}{times}")
            rows.append(" | ".join(cells))
        above = "In brackets: times less than as trained."
        table = markdown_table(" | ".join(["", *loads]).strip(), rows, above=above)
        lines += [f"## By load, root mean square, {_HORIZONS[horizon]}", "", table, ""]
    return lines


def _taken_table(car: Mapping[str, Any]) -> list[str]:
    rows = [row for row in car["rows"].values() if "taken" in row]
    if not rows:
        return []
    lines = []
    for row in rows:
        for load, taken in row["taken"].items():
            after = taken["after"] or ("refused: not better", "refused")
            cells = [cell for pair in zip(taken["before"], after, strict=True) for cell in pair]
            reported = " | ".join(cell if isinstance(cell, str) else f"{cell:.3g}" for cell in cells)
            lines.append(f"{row['title']} | {load} | {taken['ridge'] or ''} | {reported}")
    head = "| load | ridge | one step: before | after | one second: before | after"
    above = "Root mean square, scaled, on each of the robot's own drives by what was fitted to the other."
    return ["## What online tuning took", "", markdown_table(head, lines, above=above), ""]


def _real(real: Mapping[str, Any]) -> list[str]:
    if "left_out" in real:
        return ["## The real car", "", f"Left out: {real['left_out']}.", ""]
    above = (
        f"Judged on the second half of the log named. Margin: conformal, {100.0 * real['coverage']:g} %, of the error "
        "of the position, from the last quarters of the logs that were tuned on. Error: root mean square, scaled."
    )
    lines = []
    for fold in real["folds"]:
        day = " (another day)" if fold.get("other_day") else ""
        for name, row in fold["rows"].items():
            cells = []
            for horizon in HORIZONS:
                one = row[horizon]
                cells += [
                    _short(one["root_mean_square"]),
                    _short(1000.0 * one["margin"]),
                    f"{100.0 * one['covered']:.1f}",
                ]
            notice = f" ({fold['notice'][name]})" if name in fold["notice"] else ""
            lines.append(" | ".join([f"{fold['log']}{day}", f"{real['titles'][name]}{notice}", *cells]))
    head = "log | | one step: error | margin, mm | covered, % | one second: error | margin, mm | covered, %"
    return ["## The real car", "", markdown_table(head, lines, above=above), ""]


def _short(value: float) -> str:
    """Three digits, and no power of ten where it is large."""
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:.3g}"


def _ratio(ratio: Sequence[float]) -> str:
    return f"{_short(ratio[0])} ({_short(ratio[1])} to {_short(ratio[2])})"


def _span(seeds: Sequence[int]) -> str:
    return f"{seeds[0]} to {seeds[1]}"
