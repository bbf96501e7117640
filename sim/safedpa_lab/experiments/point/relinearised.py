"""A model that is not affine in the action, relinearised by its own slope, against one that is: the point robot.

With the clean thrust, and with the benchmark's, which saturates at a twentieth of its range. Every row has its own
margin. All filters get z = mu(e) of the true wind, so that only the form of the model differs.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, frame_of, save_weights
from safedpa.safety.margins.conformal import margins_over_drives, smallest_sample
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.statistics import holm, mcnemar_exact, mean_interval, wilson_interval
from safedpa_lab.experiments.common.workers import check_record, driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, named_folder, silent
from safedpa_lab.experiments.report import interval, markdown_table
from safedpa_lab.point.drivers import driven as drive
from safedpa_lab.point.drivers import evenly, windy_task
from safedpa_lab.point.free_model import save_free
from safedpa_lab.point.free_training import train_free
from safedpa_lab.point.margin import COVERAGE
from safedpa_lab.point.relinearised import (
    COMMANDS,
    FilteredDriver,
    RelinearisedFilter,
    affine_weights,
    free_model,
    model_of,
    nominal_policy_of,
)
from safedpa_sim.point.policy_task import LARGEST_FORCE
from safedpa_sim.point.task import EPISODE_STEPS
from safedpa_sim.training import progress as training_progress
from safedpa_sim.training.configuration import Configuration, load_configuration
from safedpa_sim.training.data.transitions import draw_transitions
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.prediction_errors import affine_floor
from safedpa_sim.training.phases.phase_1a import train_affine

_DRAWN: Final = 20_000
_HELD_OUT, _FLOOR = 2401, 2402
"""Seeds of what is counted; training and its own held-out pairs have seeds below 10."""
_CAR_HIDDEN: Final = 128


def thrust_configuration(thrust: str, pairs: int | None = None) -> Configuration:
    """The point's training configuration for commands of that thrust; of so many pairs, where given."""
    plain = load_configuration("point")
    largest = float(COMMANDS[thrust][0])
    phase = plain.phase_1a if pairs is None else replace(plain.phase_1a, pairs=pairs)
    return replace(plain, action={**plain.action, "thrust": (-largest, largest)}, phase_1a=phase)


def train_networks(
    out: Path, pairs: int | None = None, report_progress: training_progress.ReportProgress = training_progress.silent
) -> None:
    """Trains ``safedpa_lab.point.relinearised.NETWORKS`` into the folder, with the same pairs for both forms."""
    out.mkdir(parents=True, exist_ok=True)
    for thrust in COMMANDS:
        save_free(
            train_free(thrust_configuration(thrust, pairs), report_progress)[0], out / f"free_{thrust}.safetensors"
        )
    stock, _ = train_affine(thrust_configuration("stock", pairs), out, report_progress)
    save_weights(stock, out / "affine_stock.safetensors")


def point_errors(models: Path) -> list[dict[str, Any]]:
    """For each thrust and form: root mean square error of the velocity [m/s] and yaw [rad] over one step, share of the
    velocity's variance explained, and the share of it that nothing affine in the action explains."""
    rows = []
    for thrust in COMMANDS:
        cars = BatchedSimulator(thrust_configuration(thrust))
        floor = affine_floor(cars, cars.generator(_FLOOR))[3:].mean()
        drawn = draw_transitions(cars, _DRAWN, cars.generator(_HELD_OUT))
        environment, state, action, own = (part.double().numpy() for part in drawn)
        measured = frame_of("point").world_increment(state, own)
        affine, free = affine_weights(thrust, models), free_model(thrust, models)
        networks = LearnedNetworks(affine)
        f, g = networks.increment(state, networks.encode(environment))
        reported = {
            "affine": (f + np.einsum("nsa,na->ns", g, action), affine.digest[:16], affine.description),
            "free": (free.increment(state, free.encode(environment), action), free.digest, free.description),
        }
        for form, (predicted, digest, described) in reported.items():
            rows.append(
                {
                    "thrust": thrust,
                    "form": form,
                    "digest": digest,
                    "pairs": described.trained_on["pairs"],
                    "seed": described.trained_on["seed"],
                    "velocity": float(np.sqrt(np.square(predicted - measured)[:, 3:].mean())),
                    "yaw": float(np.sqrt(np.square(predicted - measured)[:, 2].mean())),
                    "explained": _explained(predicted[:, 3:], measured[:, 3:]),
                    "not_affine": float(floor),
                }
            )
    return rows


@final
@dataclass(frozen=True)
class CarWork:
    """A configuration of the car's training, and so many pairs of it."""

    pairs: int
    configuration: str = "car"


def car_errors(work: CarWork) -> dict[str, Any]:
    """Affine and free networks trained on the same pairs of the car's training simulator, by state: root mean square
    error (own frame, SI units), share of variance explained, and what nothing affine explains."""
    plain = load_configuration(work.configuration)
    phase = replace(plain.phase_1a, pairs=work.pairs, hidden=min(_CAR_HIDDEN, plain.phase_1a.hidden))
    asked = replace(plain, phase_1a=phase)
    with TemporaryDirectory() as folder:
        _, affine = train_affine(asked, Path(folder))
    _, free = train_free(asked)
    names = ("loss", "explained", "rms_error")
    return {
        "pairs": work.pairs,
        "configuration": work.configuration,
        "seed": asked.seed,
        "hidden": phase.hidden,
        "states": affine["states"],
        "not_affine": affine["not_affine"],
        "affine": {name: affine[name] for name in names},
        "free": {name: free[name] for name in names},
    }


def _explained(predicted: FloatArray, measured: FloatArray) -> float:
    return 1.0 - float(np.square(predicted - measured).mean() / measured.var(axis=0).mean())


PLACES: Final = (("clean", "policy"), ("stock", "disturbed"))
"""Thrust and nominal action. A disturbance of the clean thrust would show little: it is affine over its whole range.
The policy alone with the stock thrust is left out to save time."""
FILTERS: Final = {
    "affine": ("affine", "nominal"),
    "nominal": ("free", "nominal"),
    "own": ("free", "own"),
    "truth": ("truth", "own"),
}
"""Kind of model, and what it is linearised about."""
_FIRST_GUESS: Final = 0.002
"""m; the margin with which the calibrating drives go, behind the row's own filter."""


@final
@dataclass(frozen=True)
class Row:
    """One filter with one thrust and one kind of nominal action; plain values, so that it can be kept in a file."""

    thrust: str
    filter: str
    nominal: str
    models: str
    directions: int
    episodes: int
    """Of each direction."""
    steps: int
    drives: int
    drive_steps: int
    seed: int
    """Of what is counted."""
    calibration: int
    """The seed of the drives that calibrate."""


@final
@dataclass(frozen=True)
class Relinearised:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    models: Path = Path()
    directions: int = 24
    episodes: int = 2
    steps: int = EPISODE_STEPS
    drives: int = 100
    drive_steps: int = 200
    seed: int = 2400
    processes: int = 1
    record: Path | None = None

    def __post_init__(self) -> None:
        lows = {"directions": 1, "episodes": 1, "steps": 1, "processes": 1, "seed": 0, "drive_steps": 2}
        for name, low in {**lows, "drives": smallest_sample(COVERAGE)}.items():
            if getattr(self, name) < low:
                raise InputError(f"--{name}: got {getattr(self, name)}, wanted {low} or more")
        seeds_for("evaluation", 1, self.seed)

    def rows(self) -> list[Row]:
        """Place by place, filter by filter."""
        plain = str(self.models), self.directions, self.episodes, self.steps, self.drives, self.drive_steps
        seeds = seeds_for("evaluation", 1, self.seed)[0], seeds_for("calibration", 1, self.seed)[0]
        return [Row(thrust, name, nominal, *plain, *seeds) for thrust, nominal in PLACES for name in FILTERS]


def point_relinearised(asked: Relinearised, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """``rows``, with margins and what was counted, and ``against``: tests between the forms on the same episodes."""
    check_record(asked.record, Row, row_of)
    rows = driven(row_of, asked.rows(), asked.processes, report_progress, asked.record)
    reported = {
        name: getattr(asked, name) for name in ("directions", "episodes", "steps", "drives", "drive_steps", "seed")
    }
    seeds = {"evaluation_seed": rows[0]["seed"], "calibration_seed": rows[0]["calibration"]}
    plain = [{key: value for key, value in row.items() if key != "models"} for row in rows]
    return {**reported, **seeds, "coverage": COVERAGE, "force": LARGEST_FORCE, "rows": plain, "against": _against(rows)}


def row_of(row: Row) -> dict[str, Any]:
    """The row's margin, behind its own filter with a first guess, and its episodes with that margin."""
    errors = _calibrated(row)
    epsilon, every = max(0.0, margins_over_drives(errors, COVERAGE)[0]), np.concatenate(errors)
    towards = evenly(row.directions, row.episodes)
    driver = _driver(row, towards, row.seed, epsilon)
    found = drive(driver, driver.task, row.steps)
    seen, count, safe = np.concatenate(driver.seen()), len(towards), found.cost == 0.0
    return {
        **{item.name: getattr(row, item.name) for item in fields(row)},
        "epsilon": epsilon,
        "calibrated_on": len(every),
        "median_error": float(np.median(np.abs(seen))) if len(seen) else None,
        "error_99": float(np.quantile(seen, COVERAGE)) if len(seen) else None,
        "near": len(seen),
        "count": count,
        "safe": int(safe.sum()),
        "safe_interval": list(wilson_interval(int(safe.sum()), count)),
        "unsafe_steps": int(found.cost.sum()),
        "least_room": float(found.least_room.min()),
        "goals": mean_interval(found.goals),
        "corrected": found.corrected,
        "relaxed": found.relaxed,
        "microseconds": 1e6 * driver.seconds / count / row.steps,
        "safe_each": "".join("1" if one else "0" for one in safe),
        "goals_each": found.goals.astype(int).tolist(),
    }


def _calibrated(row: Row) -> list[FloatArray]:
    """The errors [m] along each drive."""
    towards = np.random.default_rng([row.calibration, 61]).uniform(0.0, 2.0 * np.pi, row.drives)
    driver = _driver(row, towards, row.calibration, _FIRST_GUESS)
    for _ in range(row.drive_steps):
        driver.task.advance(driver.act())
    return driver.errors()


def _driver(row: Row, towards: FloatArray, seed: int, epsilon: float) -> FilteredDriver:
    kind, about = FILTERS[row.filter]
    models = Path(row.models)
    task = windy_task(towards, LARGEST_FORCE, seed, stock=row.thrust == "stock")
    nominal = nominal_policy_of(row.nominal, row.thrust, task, models, seed)
    return FilteredDriver(task, model_of(kind, row.thrust, task, models), RelinearisedFilter(epsilon, about), nominal)


def _against(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Each relinearised filter against the affine one: exact McNemar over episodes, Holm over all lines; goals less."""
    by = {(row["thrust"], row["nominal"], row["filter"]): row for row in rows}
    found = []
    for (thrust, nominal, name), row in by.items():
        if name != "affine":
            affine = by[thrust, nominal, "affine"]
            pair = [np.array([flag == "1" for flag in one["safe_each"]]) for one in (row, affine)]
            more, fewer, p = mcnemar_exact(*pair)
            goals = np.array(row["goals_each"], dtype=np.float64) - np.array(affine["goals_each"], dtype=np.float64)
            reported = {
                "thrust": thrust,
                "nominal": nominal,
                "filter": name,
                "only_it": more,
                "only_affine": fewer,
                "mcnemar": p,
            }
            found.append({**reported, "goals_less": mean_interval(goals)})
    for line, p in zip(found, holm([line["mcnemar"] for line in found]), strict=True):
        line["holm"] = p
    return found


_QUICK = {"directions": 2, "episodes": 1, "steps": 40, "drive_steps": 10}


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point-relinearised``."""
    quick, models, pairs = options["quick"], options["models"], options["car_pairs"]
    asked = {name: value for name, value in options.items() if name not in ("quick", "car_pairs", "train", "out")}
    wanted = Relinearised(**asked | (_QUICK if quick else {}))
    if options["train"]:
        train_networks(models)
    else:
        named_folder("--models", models)
    result = {"date": time.strftime("%Y-%m-%d"), "quick": quick, **point_relinearised(wanted, report_progress)}
    result["networks"] = point_errors(models)
    if pairs is not None:
        record = wanted.record and wanted.record.with_suffix(".car.jsonl")
        result["car"] = driven(car_errors, [CarWork(pairs)], 1, record=record)[0]
    return result


_TITLES: Final = {
    "affine": "affine networks",
    "nominal": "free networks about the nominal action",
    "own": "free networks about the filter's own action",
    "truth": "the body itself about the filter's own action",
}


def relinearised_markdown(result: Mapping[str, Any]) -> str:
    """Networks, rows, tests, and optionally the car."""
    parts = ["## Networks", models_table(result), "## Filters with z = mu(e)", rows_table(result)]
    parts += ["## Against the affine networks", against_table(result)]
    if "car" in result:
        parts += ["## The car's networks", car_table(result)]
    return "\n\n".join(parts) + "\n"


def models_table(result: Mapping[str, Any]) -> str:
    """One-step errors of the point robot's networks on fresh transitions."""
    rows = []
    for row in result["networks"]:
        rows.append(
            f"{row['thrust']} | {row['form']} | {1e3 * row['velocity']:.2f} | {1e3 * row['yaw']:.2f} "
            f"| {100 * row['explained']:.4f} | {100 * row['not_affine']:.4f}"
        )
    return markdown_table(
        "thrust | networks | velocity, mm/s | yaw, mrad | explained of the velocity, % | no affine one can, %", rows
    )


def rows_table(result: Mapping[str, Any]) -> str:
    """Each filter with its own margin, by thrust and nominal action."""
    rows = []
    for row in result["rows"]:
        low, high = row["safe_interval"]
        reported = " / ".join(_millimetres(row[name]) for name in ("median_error", "error_99"))
        safe = f"{100 * row['safe'] / row['count']:.1f} ({100 * low:.1f} to {100 * high:.1f})"
        rows.append(
            f"{row['thrust']} | {row['nominal']} | {_TITLES[row['filter']]} | {reported} "
            f"| {_millimetres(row['epsilon'])} | {safe} "
            f"| {row['goals'][0]:.1f} | {100 * row['corrected']:.1f} | {row['microseconds']:.0f}"
        )
    return markdown_table(
        "thrust | nominal action | filter with z = mu(e) | error, median / 99 %, mm | margin, mm "
        "| episodes without cost, % | goals | corrected, % | us a decision",
        rows,
        above=f"{result['directions']} directions x {result['episodes']} episodes of {result['steps']} steps, "
        f"evaluation seed {result['evaluation_seed']}; margins of {100 * result['coverage']:g} % over "
        f"{result['drives']} drives of {result['drive_steps']} steps, calibration seed "
        f"{result['calibration_seed']}; {result['date']}.",
    )


def against_table(result: Mapping[str, Any]) -> str:
    """Episodes that only one of the two drove without cost."""
    rows = []
    for row in result["against"]:
        rows.append(
            f"{row['thrust']} | {row['nominal']} | {_TITLES[row['filter']]} | +{row['only_it']} -{row['only_affine']} "
            f"| {row['holm']:.1g} | {interval(row['goals_less'])}"
        )
    return markdown_table("thrust | nominal action | against the affine networks | safe | p | goals more", rows)


def car_table(result: Mapping[str, Any]) -> str:
    """One-step errors of the car's networks, state by state."""
    car = result["car"]
    rows = []
    for index, name in enumerate(car["states"]):
        affine, free = car["affine"], car["free"]
        left = (f"{100 * (1.0 - one['explained'][index]):.3f} %" for one in (affine, free))
        errors = (f"{one['rms_error'][index]:.2e}" for one in (affine, free))
        rows.append(f"{name} | {' | '.join([*errors, *left])} | {100 * car['not_affine'][index]:.3f} %")
    return markdown_table(
        "state | affine, error | free, error | affine, not explained | free, not explained | no affine one can",
        rows,
        above=f"{car['pairs']:,} pairs each, two layers of {car['hidden']} in f and g, seed {car['seed']}.",
    )


def _millimetres(length: float | None) -> str:
    return "none" if length is None else f"{1e3 * length:.2f}"
