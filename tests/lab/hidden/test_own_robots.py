"""Ten robots that do not ship: the plants are right by the models that they share no code with."""

import ast
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from safedpa.comparison.rollout_error import rollout_error
from safedpa.comparison.windows import windows_of
from safedpa.dynamics import Setting, load_model
from safedpa.dynamics.user_files import load_user_file
from safedpa.effects import effect
from safedpa.records import load_run
from safedpa_lab.experiments.diagnosis.own_robots import run_case, truth_error
from safedpa_lab.own_robots import models, plants
from safedpa_lab.own_robots.cases import STRENGTHS, SUITES, OwnCase, cases_of, truth_of, write_case

pytestmark = pytest.mark.slow
LIBRARY = {(item.robot, item.name): item for item in models.EFFECTS}


@pytest.fixture(autouse=True, scope="module")
def loaded() -> None:
    """The robots and their effects, in this process alone."""
    load_user_file(Path(models.__file__))


def is_known(robot: str, name: str) -> bool:
    """Whether the library has an effect of that name whose bounds hold what is hidden."""
    known, hidden = LIBRARY.get((robot, name)), STRENGTHS[robot][name]
    return known is not None and all(item.low <= hidden[item.name] <= item.high for item in known.parameters)


KNOWN = [(robot, name) for robot, table in STRENGTHS.items() for name in table if is_known(robot, name)]
TRUE = {
    "own_servo": {"stiffness": 210.0, "damping": 22.0},
    "own_joint": {"gain": 2.1, "gravity": 6.2},
    "own_tank": {"inflow": 0.0042, "outflow": 0.021},
    "own_motor": {"gain": 52.0},
    "own_conveyor": {"gain": 2.1},
}
"""Parameters of the plants that their given models have wrong."""


def error(case: OwnCase, folder: Path, *, with_effect: bool) -> float:
    path, runs, _ = write_case(case, folder)
    text = path.read_text(encoding="utf-8")
    for key, value in TRUE.get(case.robot, {}).items():
        text = re.sub(rf"(?m)^{key} = .*$", f"{key} = {value}", text)
    path.write_text(text, encoding="utf-8")
    model = load_model(path)
    for name, parameters in case.effects.items() if with_effect else ():
        model = model.with_effect(effect(case.robot, name), {key: Setting(value) for key, value in parameters.items()})
    horizon = 25 * model.period  # long enough for the effect to exceed the noise of the first row
    return rollout_error(model, windows_of([load_run(runs[0], model.system)], horizon, every=horizon)).value


def test_the_plants_share_no_code_with_the_product() -> None:
    tree = ast.parse(Path(plants.__file__).read_text(encoding="utf-8"))
    names = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    assert not [name for name in names if name.startswith("safedpa")]


@pytest.mark.long
@pytest.mark.parametrize(("robot", "name"), KNOWN, ids=map("-".join, KNOWN))
def test_a_model_with_the_true_effect_predicts_better_than_without(robot: str, name: str, tmp_path: Path) -> None:
    case = OwnCase("own_one", robot, 3, {name: STRENGTHS[robot][name]}, 1)
    assert error(case, tmp_path, with_effect=True) < 0.9 * error(case, tmp_path, with_effect=False)


def test_the_same_seed_gives_the_same_cases_and_every_robot_its_turn(tmp_path: Path) -> None:
    for suite in SUITES:
        cases = cases_of(suite, 20, 5)
        assert cases == cases_of(suite, 20, 5)
        assert {case.robot for case in cases} == set(plants.PLANTS)
        assert {case.runs for case in cases} == {1, 3}
        assert len({case.name for case in cases}) == 20
    case = OwnCase("own_one", "own_conveyor", 5, {"target_gain": {"gain": 0.9}}, 1)
    first, second = (write_case(case, tmp_path / name)[1][0].read_text() for name in "ab")
    assert first == second
    assert truth_of(case)["effects"].keys() == case.effects.keys()


def test_commands_change_between_the_rows_and_the_log_has_the_one_in_force() -> None:
    plant = plants.PLANTS["own_conveyor"]
    times, states, commands = plants.drive(plant, {}, 1)
    assert times == pytest.approx(plant.period * np.arange(len(times)))
    changes = np.flatnonzero(np.diff(commands[:, 0]))
    # Right after a change the belt has followed for a part of the period only.
    late = (states[changes + 1, 0] - states[changes, 0]) - (states[changes, 0] - states[changes - 1, 0])
    assert len(changes) > 10
    assert (np.abs(late) > 3 * plant.noise[0]).sum() > 3


@pytest.mark.long
def test_a_case_is_diagnosed_and_judged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SAFEDPA_EFFECTS", "")  # what the case adds to it is gone afterwards
    outcome = run_case(OwnCase("own_one", "own_conveyor", 2, {"target_dead_zone": {"width": 0.25}}, 1))
    assert outcome.hidden == ("target_dead_zone",)
    assert outcome.verdict
    assert np.isfinite(outcome.error_ratio)


@pytest.mark.parametrize("robot", plants.PLANTS)
def test_a_resonance_rings_and_does_not_diverge(robot: str) -> None:
    plant = plants.PLANTS[robot]
    plant = replace(plant, seconds=4.0 * plant.hold[1])
    plain, ringing = (plants.drive(plant, {}, 3, outside)[1] for outside in ("", "resonance"))
    assert np.abs(ringing).max() < 3.0 * np.abs(plain).max()
    assert np.abs(ringing - plain).max() > 0.0


@pytest.mark.long
def test_commands_that_change_between_rows_are_no_drag() -> None:
    outcome = run_case(OwnCase("own_none", "own_motor", 3243408480, {}, 3))
    assert (outcome.verdict, outcome.added) == ("nothing_missing", ())


def test_the_true_robot_errs_by_the_noise_alone(tmp_path: Path) -> None:
    case = OwnCase("own_outside", "own_conveyor", 7, {}, 1, "quantised")
    model, runs, _ = write_case(case, tmp_path)
    assert truth_error(case, model, runs) < 0.03  # noise of 0.01 m/s at the start and the end


def test_predictions_by_the_true_robot_end_where_it_drove() -> None:
    plant = replace(plants.PLANTS["own_conveyor"], seconds=5.0, noise=(0.0,))
    _, states, _ = plants.drive(plant, {"target_delay": {"seconds": 0.2}}, 3, "heat")
    windows = [(first, first + 10, states[first]) for first in (0, 7, 40)]
    ends = plants.predicted(plant, {"target_delay": {"seconds": 0.2}}, 3, "heat", windows)
    assert np.array_equal(ends, states[[10, 17, 50]])
