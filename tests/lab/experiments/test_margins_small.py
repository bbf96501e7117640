"""The command that makes the margins that ship, in small: resumed, repeated, on seeds of its own."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError
from safedpa.safety import MarginCalibration
from safedpa_lab.commands.experiments.margins import command
from safedpa_lab.experiments.margin_drives import DRIVERS, DriveOrder, driven
from safedpa_lab.experiments.seeds import SEEDS, seeds_for

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
    cut = CliRunner().invoke(command, [*asked, "--minutes", "1e-9"])
    assert cut.exit_code == 0, cut.output
    assert json.loads(cut.output)["missing"] == 15
    done = CliRunner().invoke(command, asked)
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
    assert "safedpa experiment margins --robot pendulum --drives 4 --fresh 2 --skip 5 --kind" in page
    seeds = {path.name.partition("-")[0] for path in tmp_path.glob("pendulum/fresh-*/*.npz")}
    assert seeds == {"2000005", "2000006"}, "of the evaluation seeds the first five are left out"
    assert f"| pendulum | corridor | drive | {margin.drive['corridor']:.4f} |" in page
    assert page.count("| pendulum |") == 6, "both margins in three tables"
    before = {path.name: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")}
    again = CliRunner().invoke(command, asked)
    assert json.loads(again.output) == result, "nothing is driven twice, and the same comes out"
    assert {path.name: path.stat().st_mtime_ns for path in tmp_path.rglob("*.npz")} == before


@pytest.mark.parametrize(("name", "epsilon"), [("pendulum", 0.0292), ("point_learned", 0.003)])
def test_what_ships_is_counted_alone(name: str, epsilon: float, tmp_path: Path) -> None:
    """A calibrated margin, or the one that the settings assume."""
    asked = ["--robot", name, "--drives", "0", "--fresh", "2", "--kind", "shipped", "--seconds", "1"]
    done = CliRunner().invoke(command, [*asked, "--processes", "1", "--out", str(tmp_path), "--json"])
    assert done.exit_code == 0, done.output
    result = json.loads(done.output)
    assert result["missing"] == 0
    (counted,) = result["robots"][name]["fresh_shipped"]["covered"].values()
    assert counted["drives"] == 2
    assert counted["shipped"]["epsilon"] == pytest.approx(epsilon, abs=5e-5)
    assert not (tmp_path / name / "margin.toml").exists(), "nothing was calibrated"
    page = (tmp_path / "margins.md").read_text()
    assert f"| shipped | {epsilon:.4f} |" in page
    assert f"--robot {name} --drives 0 --fresh 2 --kind shipped" in page


@pytest.mark.parametrize("bad", [["--robot", "carr"], ["--kind", "both"], ["--drives", "0"], ["--minutes", "-1"]])
def test_what_is_no_order_is_refused(bad: list[str], tmp_path: Path) -> None:
    refused = CliRunner().invoke(command, [*bad, "--out", str(tmp_path)])
    assert isinstance(refused.exception, InputError)


@pytest.mark.parametrize("name", DRIVERS)
def test_every_shipped_robot_can_be_driven_and_its_errors_are_numbers(name: str) -> None:
    made = driven(DriveOrder(name, 1, None, seconds=0.6))
    assert made.heights.keys() >= ({"corridor"} if "pendulum" in name else {"obstacle"})
    assert all(np.isfinite(values).all() and values.shape[1] == 4 for values in made.heights.values())
    assert made.ticks == round(0.6 / (DRIVERS[name].period or load_model(DRIVERS[name].model).period))
    again = driven(DriveOrder(name, 1, None, seconds=0.6))
    assert (again.goals, again.statuses, again.least_h) == (made.goals, made.statuses, made.least_h)
