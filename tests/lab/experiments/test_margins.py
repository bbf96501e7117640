"""Margins: from drives whose heights are given, and by the command that makes those that ship, in small."""

import json
import time
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.safety import MarginCalibration
from safedpa_lab.commands.experiment import EXPERIMENTS, ExperimentCommand
from safedpa_lab.experiments.common.seeds import SEEDS, seeds_for
from safedpa_lab.experiments.common.statistics import mean_interval
from safedpa_lab.experiments.margins import experiment as margins
from safedpa_lab.experiments.margins.drives import DRIVERS, DriveOrder, DriveResult, driven
from safedpa_lab.experiments.margins.experiment import MarginCases, margins_experiment
from safedpa_lab.experiments.sensing import margins as sensing_margins
from safedpa_lab.experiments.sensing.scores import Score

COMMAND = ExperimentCommand(EXPERIMENTS["margins"])

LAYERS = [
    np.pad([[0.9, 0.9], [0.9, 0.010], [0.009, 0.008], [0.9, 0.9], [0.9, 0.9]], ((0, 0), (0, 2))),
    np.pad([[0.9, 0.9], [0.9, 0.020], [0.018, 0.015], [0.013, 0.012], [0.9, 0.9]], ((0, 0), (0, 2))),
]
"""Of two drives the least h as it was predicted and as it was measured: one is near for two ticks, one for three."""


class Drives:
    """Made-up drives of the car: by seed its goals, contacts and least h; one step near an obstacle, one far away."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.made: list[DriveOrder] = []
        self.now = 0.0
        patch.setattr(margins, "driven", self.driven)
        patch.setattr(time, "monotonic", lambda: self.now)

    def driven(self, order: DriveOrder) -> DriveResult:
        """Takes a second."""
        self.made.append(order)
        self.now += 1.0
        number = order.seed % 10
        near = np.array([[0.2, 0.2 - 0.01 * number, 0.0, 0.0], [0.1, 0.1 - 0.002 * number, 0.0, 0.0]])
        if order.seed >= 2_000_000:  # an evaluation
            near = LAYERS[number % 2]
        heights = {"obstacle": near, "field": near[:1] if number % 2 else np.zeros((0, 4)), "speed": near[:1]}
        statuses = {"passed": 3, "fallback": 1} if number == 3 else {"passed": 4}
        return DriveResult(order.seed, heights, number, number % 3, 4, statuses, 0.5 - 0.1 * number)


def cases(out: Path, **changes: Any) -> MarginCases:
    usual: dict[str, Any] = {"drives": 6, "fresh": 2, "seconds": 30.0, "coverage": 0.5, "processes": 1}
    return MarginCases(("car",), out, **{**usual, **changes})


def test_margins_come_from_all_drives_and_count_what_they_cover(tmp_path, monkeypatch) -> None:
    drives = Drives(monkeypatch)
    reported: list[tuple[int, int]] = []
    wanted = cases(tmp_path)
    found = margins_experiment(wanted, lambda *done: reported.append(done))
    total = wanted.first + 2 * 6 + 2 * 2
    assert (found["missing"], reported[-1], len(drives.made)) == (0, (total, total), total)
    row = found["robots"]["car"]
    behind = [order for order in drives.made if order.kind == "conformal" and order.margin is not None][:6]
    assert behind[0].margin is not None
    assert behind[0].margin.coverage == pytest.approx(0.5 * wanted.first / (wanted.first + 1)), "the plain quantile"
    seeds = [order.seed for order in behind]
    counted = row["calibration_conformal"]
    assert (counted["drives"], counted["goals"]) == (6, sum(seed % 10 for seed in seeds))
    assert counted["goals_a_minute"] == mean_interval(np.array([2.0 * (seed % 10) for seed in seeds]))
    assert counted["collisions"] == sum(seed % 10 % 3 for seed in seeds)
    assert counted["statuses"]["passed"] == sum(3 if seed % 10 == 3 else 4 for seed in seeds)
    assert counted["least_h"] == pytest.approx(min(0.5 - 0.1 * (seed % 10) for seed in seeds))
    covered = counted["covered"]
    assert (covered["obstacle"]["drives"], covered["obstacle"]["drives_near"]) == (6, 6)
    assert (covered["field"]["drives"], covered["field"]["drives_near"]) == (6, sum(seed % 2 for seed in seeds))
    assert covered["obstacle"]["conformal"]["epsilon"] == row["epsilon"]["obstacle"]
    assert covered["obstacle"]["drive"]["drives"] >= 0.5, "at least the coverage that was asked for"
    layer = row["fresh_conformal"]["layer"]["obstacle"]
    assert 0.02 < layer.pop("depth") < 0.9
    assert layer == pytest.approx(
        {"stays": 2, "longest_seconds": 3 * 30.0 / 4, "fall": 0.008, "errors": 0.004, "least_rise": -0.002}
    )


def test_drives_that_are_kept_are_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Time for four drives, then for the rest: the same margins as without an interruption, and each drive once."""
    drives = Drives(monkeypatch)
    cut = margins_experiment(cases(tmp_path / "cut", minutes=3.5 / 60.0))
    whole = cases(tmp_path / "cut")
    assert (cut["missing"], len(drives.made)) == (whole.total - 4, 4)
    reported: list[tuple[int, int]] = []
    rest = margins_experiment(whole, lambda *done: reported.append(done))
    assert (rest["missing"], len(drives.made)) == (0, whole.total)
    assert len({(order.seed, order.kind, order.margin is None) for order in drives.made}) == whole.total
    assert reported[0][0] > 0, "kept drives count as done at once"
    assert margins_experiment(cases(tmp_path / "other"))["robots"] == rest["robots"]
    assert len(drives.made) == 2 * whole.total
    files = [path.name for path in (tmp_path / "cut").rglob("*.npz")]
    assert len(files) == whole.total
    assert not any(name.startswith("new-") for name in files)


@pytest.mark.parametrize("short", [0, 1])
def test_no_margin_is_made_from_fewer_drives_than_asked_for(short, tmp_path, monkeypatch) -> None:
    """Time ends one drive before the first or the second kind of margin has all its drives."""
    Drives(monkeypatch)
    wanted = cases(tmp_path)
    seconds = wanted.first + 6 * (1 + short) - 1.5
    row = margins_experiment(cases(tmp_path, minutes=seconds / 60.0))["robots"]["car"]
    assert row == {"drives": 6 * (1 + short) - 1}


def scored(seed: int, *errors: tuple[str, float, float], **more: Any) -> dict[str, Any]:
    """A drive with steps of a kind, as they were hoped and as they came."""
    scores = [
        list(Score(kind, 0.1 * n, hoped, true, 0.5, -1, 0.0, (0.1, 0.3, 0.2), 0.05))
        for n, (kind, hoped, true) in enumerate(errors)
    ]
    usual = {"scene": "people", "load": "none", "goals": 1, "moving": []}
    return {**usual, "seed": seed, "scores": scores, **more}


BEFORE = [
    scored(1, ("obstacle", 0.3, 0.2), ("obstacle", 0.9, 0.1), ("mover", 0.4, 0.5), goals=2),
    scored(2, ("obstacle", 0.2, 0.7), goals=3, moving=["x"]),
    scored(3, goals=0),
]
AFTER = [
    scored(4, ("obstacle", 0.1, 0.2), ("obstacle", 0.1, 0.1), ("obstacle", 0.4, 0.1), goals=5, moving=["y", "z"]),
    scored(5, ("mover", 1.0, 1.0)),
]


@pytest.fixture
def sensed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    margin = SimpleNamespace(epsilon={"obstacle": 0.05}, drive={"obstacle": 0.3 + 1e-9})
    monkeypatch.setattr(sensing_margins, "smallest_sample", lambda _: 3)
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: [*BEFORE, *AFTER])
    monkeypatch.setattr(sensing_margins, "calibration_from_drives", lambda *_: margin)
    return sensing_margins.margins_of_sensing(3, 2, 5.0, 0.5)


@pytest.mark.parametrize(
    ("kind", "steps", "near", "largest", "worst"),
    [("obstacle", 5, 2, 0.4, (1, 4)), ("mover", 1, 1, -0.1, (1,)), ("hidden", 0, 0, None, ())],
)
def test_steps_and_drives_near_something_are_counted_by_kind(kind, steps, near, largest, worst, sensed) -> None:
    """Of an obstacle steps below 0.5 m count, of a mover below 1 m; what is hoped farther counts as far as that."""
    (row,) = [row for row in sensed["rows"] if row["kind"] == kind]
    assert (row["steps"], row["drives_near"]) == (steps, near)
    assert row["quantiles"].get("1") == (None if largest is None else pytest.approx(largest))
    assert [one["drive"] for one in row["worst"]] == [f"people, load none, seed {seed}" for seed in worst]


def test_margins_of_a_laser_are_reported_with_what_they_cover(sensed: dict[str, Any]) -> None:
    rows = {row["kind"]: row for row in sensed["rows"]}
    assert (rows["obstacle"]["step"], rows["obstacle"]["drive"]) == (0.05, 0.3 + 1e-9)
    assert rows["obstacle"]["out"]["0.5"] == pytest.approx(0.1), "the nearer of points and movers"
    assert rows["mover"]["out"]["0.5"] == pytest.approx(0.25), "grown by 0.05"
    fresh = rows["obstacle"]["fresh"]
    assert {"step", "drive"} <= set(fresh)
    assert fresh["step"]["drives"] == 0.5, "of two fresh drives one came too near"
    assert (sensed["goals"], len(sensed["moving"])) == (11, 3)


@pytest.mark.parametrize("near", [(), (1,), (0, 2)])
def test_margins_of_a_laser_need_a_drive_that_came_near_something(near, monkeypatch) -> None:
    class ReachedError(Exception):
        pass

    def calibrated(heights: Any, *_: Any) -> Any:
        raise ReachedError(str([len(one.get("obstacle", ())) for one in heights]))

    drives = [scored(n, *[("obstacle", 0.2, 0.1)] * (n + 1 if n in near else 0)) for n in range(5)]
    monkeypatch.setattr(sensing_margins, "smallest_sample", lambda _: 3)
    monkeypatch.setattr(sensing_margins, "driven", lambda *_: drives)
    monkeypatch.setattr(sensing_margins, "calibration_from_drives", calibrated)
    with pytest.raises(ReachedError if near else InputError) as raised:
        sensing_margins.margins_of_sensing(3, 2, 5.0, 0.5)
    counts = str([n + 1 if n in near else 0 for n in range(3)])
    assert (counts if near else "in none the car came near anything") in str(raised.value)


SMALL = ["--robot", "pendulum", "--drives", "4", "--fresh", "2", "--coverage", "0.7", "--seconds", "1"]


def test_seeds_of_one_purpose_are_those_of_no_other() -> None:
    for one, other in combinations(SEEDS.values(), 2):
        assert not set(one) & set(other)


@pytest.mark.parametrize(("purpose", "first"), [("development", 0), ("calibration", 10**6), ("evaluation", 2 * 10**6)])
def test_a_hundred_thousand_seeds_belong_to_each_purpose(purpose: str, first: int) -> None:
    assert seeds_for(purpose, 100_000) == range(first, first + 100_000)
    assert seeds_for(purpose, 3, 99_997) == range(first + 99_997, first + 100_000)
    assert len(seeds_for(purpose, 0, 100_000)) == 0
    for count, skip in ((100_001, 0), (1, 100_000), (4, 99_997), (-1, 5), (5, -1)):
        with pytest.raises(InputError, match=rf"got {skip} \+ {count}, wanted at most 100000"):
            seeds_for(purpose, count, skip)
    with pytest.raises(InputError, match="seeds for"):
        seeds_for(purpose[:-1], 1)


@pytest.mark.long
def test_the_command_makes_margins_counts_them_and_goes_on_where_it_was_cut(tmp_path: Path) -> None:
    asked = [*SMALL, "--skip", "5", "--processes", "1", "--out", str(tmp_path), "--json"]
    cut = CliRunner().invoke(COMMAND, [*asked, "--minutes", "1e-9"])
    assert cut.exit_code == 0, cut.output
    assert json.loads(cut.output)["missing"] == 15
    done = CliRunner().invoke(COMMAND, asked)
    assert done.exit_code == 0, done.output
    result = json.loads(done.output)
    assert result["missing"] == 0
    row = result["robots"]["pendulum"]
    margin = MarginCalibration.load(tmp_path / "pendulum" / "margin.toml")
    assert margin.fingerprint == fingerprint(load_model("pendulum"))
    assert (margin.drives, margin.coverage) == (4, 0.7)
    assert "seeds 1000003 to 1000006" in margin.origin, "three drives go before"
    assert "--drives 4 --coverage 0.7:" in margin.origin
    assert 0.0 < margin.epsilon["corridor"] <= margin.drive["corridor"]
    for kind in ("conformal", "drive"):
        fresh = row[f"fresh_{kind}"]
        assert fresh["drives"] == 2
        counted = fresh["covered"]["corridor"][kind]
        assert 0.0 <= counted["steps"] <= 1.0
        assert margin.covered[f"{kind}.corridor"] == counted["drives" if kind == "drive" else "steps"]
    page = (tmp_path / "margins.md").read_text()
    assert "margins --robot pendulum --drives 4 --fresh 2 --skip 5" in page
    seeds = {path.name.partition("-")[0] for path in tmp_path.glob("pendulum/fresh-*/*.npz")}
    assert seeds == {"2000005", "2000006"}, "of the evaluation seeds the first five are left out"
    assert f"| pendulum | corridor | drive | {margin.drive['corridor']:.4f} |" in page
    assert page.count("| pendulum |") == 6, "both margins in three tables"
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    again = CliRunner().invoke(COMMAND, asked)
    assert json.loads(again.output) == result, "nothing is driven twice, and the same comes out"
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == before


@pytest.mark.parametrize(("name", "epsilon"), [("pendulum", 0.0292), ("point_learned", 0.003)])
def test_what_ships_is_counted_alone(name: str, epsilon: float, tmp_path: Path) -> None:
    """A calibrated margin, or the one that the settings assume."""
    asked = ["--robot", name, "--drives", "0", "--fresh", "2", "--kind", "shipped", "--seconds", "1"]
    done = CliRunner().invoke(COMMAND, [*asked, "--processes", "1", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.output)
    assert result["missing"] == 0
    (counted,) = result["robots"][name]["fresh_shipped"]["covered"].values()
    assert (counted["drives"], counted["shipped"]["epsilon"]) == (2, pytest.approx(epsilon, abs=5e-5))
    assert not (tmp_path / name / "margin.toml").exists(), "nothing was calibrated"
    page = (tmp_path / "margins.md").read_text()
    assert f"| shipped | {epsilon:.4f} |" in page
    assert f"--robot {name} --drives 0 --fresh 2 --kind shipped" in page


@pytest.mark.parametrize("name", DRIVERS)
def test_every_shipped_robot_can_be_driven_and_its_errors_are_numbers(name: str) -> None:
    made = driven(DriveOrder(name, 1, None, seconds=0.6))
    assert made.heights.keys() >= ({"corridor"} if "pendulum" in name else {"obstacle"})
    assert all(np.isfinite(values).all() and values.shape[1] == 4 for values in made.heights.values())
    assert made.ticks == round(0.6 / (DRIVERS[name].period or load_model(DRIVERS[name].model).period))
    again = driven(DriveOrder(name, 1, None, seconds=0.6))
    assert (again.goals, again.statuses, again.least_h) == (made.goals, made.statuses, made.least_h)
