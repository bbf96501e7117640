"""The check of a filter finds each planted fault, says what to do, and is silent where all is well."""

import re
import runpy
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.safety.checked import first, made, probe

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.robots.point.scene import PointScene
from safedpa.safety import (
    AbstractBarrier,
    CorridorBarrier,
    FilterReport,
    FilterSession,
    FilterSettings,
    FunctionBarrier,
    HigherOrderBarrier,
    PendingActions,
    RolloutBarrier,
    SafetyFilter,
    check_filter,
)
from safedpa.safety.checks.backup import backup_issues
from safedpa.safety.checks.report import FilterIssue, collect, format_vector
from safedpa.safety.defaults import settings_named

DOCS = Path(__file__).parents[2] / "docs"
PAGE, EXAMPLES = (DOCS / "guides" / "safety.md").read_text(encoding="utf-8"), DOCS / "examples"
PERIOD = 0.05
STATES = ([0.5, 0.8], [0.0, 0.0])
SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.002)


def affine(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.array([x[0] + PERIOD * x[1], x[1]]), np.array([[0.5 * PERIOD**2], [PERIOD]])


def room(x: np.ndarray) -> float:
    return float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0))


def brake(x: np.ndarray) -> np.ndarray:
    return np.clip(-x[1:] / PERIOD, -1.0, 1.0)


def report(
    h: AbstractBarrier | Callable[[np.ndarray], Any] = room, *, settings: FilterSettings = SETTINGS,
    backup: Callable[[Any], Any] | None = None, states: Any = STATES, **known: Any,
) -> FilterReport:  # fmt: skip
    barrier = h if isinstance(h, AbstractBarrier) else FunctionBarrier(h, **known)
    return check_filter(SafetyFilter(affine, [barrier], settings, backup=backup), states)


def test_the_first_example_of_the_page_is_fine() -> None:
    names: dict[str, Any] = {}
    exec(re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)[0].partition("print(")[0], names)
    random = np.random.default_rng(0)
    for states in (STATES, [0.0, 0.0], random.uniform((-2.0, -1.0), (0.9, 1.2), (20, 2))):
        found = check_filter(names["safe"], states)
        assert not found
        first, _, notes = str(found).partition("\n")
        assert first == f"No issue at {found.states} states."
        assert notes.startswith("Note (decision): made by Python instead of compiled C")
        assert found.states > len(np.atleast_2d(states))


@pytest.mark.parametrize(
    "settings", [FilterSettings.for_robot("car"), settings_named("car")], ids=["default", "shipped"]
)
def test_the_car_is_fine(settings: FilterSettings) -> None:
    model, random = load_model("car"), np.random.default_rng(0)
    barriers = car_barriers(
        settings, (0.08, 0.40, 0.12), [(2.0, 0.0, 0.3), (-1.5, 1.0, 0.25), (0, -2, 0.2)], (-4, 4, -4, 4)
    )
    states = random.uniform((-3, -3, -3, -0.6), (3, 3, 3, 2), (40, 4))
    found = check_filter(SafetyFilter.for_model(model, settings, barriers), states, latent=model.latent)
    assert not found, str(found)


def test_the_pendulum_is_fine_but_has_no_stand() -> None:
    model, settings = load_model("pendulum"), settings_named("pendulum")
    safe = SafetyFilter.for_model(model, settings, [CorridorBarrier(-1.0, 1.0, settings.barrier("corridor_seconds"))])
    states = np.random.default_rng(0).uniform((-1.0, -2.0), (1.0, 2.0), (40, 2))
    found = check_filter(safe, states, latent=model.latent, can_stop=False)
    assert not found, str(found)
    assert check_filter(safe, states, latent=model.latent).subjects == {"backup"}


@pytest.mark.long
def test_the_point_robot_is_fine() -> None:
    model, settings, latent = load_model("point_wind"), settings_named("point"), np.array([0.5, -0.3])
    scene, random = PointScene(model, settings), np.random.default_rng(0)
    scene.learn(latent)
    reported = StateMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=0.0, values=(0.0,) * 5, applied=(0.0, 0.0), applied_by="none",
        period=0.02, lockstep=True, goal=(1.0, 1.0), obstacles=((0.7, 0.0, 0.2), (-0.8, 0.3, 0.2)), field=(),
        footprint=(),
    )  # fmt: skip
    barriers = scene.of(reported)
    assert not isinstance(barriers, str)
    states = random.uniform((-0.4, -0.4, -3, -0.3, -0.3), (0.4, 0.4, 3, 0.3, 0.3), (6, 5))
    safe = SafetyFilter.for_model(model, settings, barriers, backup=scene.backup)
    found = check_filter(FilterSession(safe), states, latent=latent, ticks=24)
    assert not found, str(found)


@pytest.mark.long
def test_rollouts_higher_orders_and_delays_that_fit_are_fine() -> None:
    wall = RolloutBarrier(affine, brake, lambda x: 1.0 - x[0], 40)
    assert not report(wall, backup=wall.backup)
    speed = HigherOrderBarrier([lambda x: 1.0 - x[0], lambda x: -x[1]], [lambda h: np.sqrt(np.maximum(h, 0.0))])
    assert not report(speed)
    late = PendingActions(affine, 3, (0.0,))
    safe = SafetyFilter(late.prediction, [late.barrier(FunctionBarrier(room))], SETTINGS)
    assert not check_filter(safe, late.state([0.0, 0.0]))


@pytest.mark.long
def test_the_example_among_discs_runs_and_hits_nothing() -> None:
    notice = runpy.run_path(str(EXAMPLES / "stopping_among_discs.py"))["main"]()
    assert notice.startswith("No issue")
    assert float(re.findall(r"least room (\S+) cm", notice)[0]) >= 0.0


def test_a_wrong_unit_and_actions_that_change_h_by_less_than_the_margin_are_reported() -> None:
    small = report(lambda x: 1e-8 * room(x))
    assert small.subjects == {"scale"}
    assert "are h and epsilon in the same unit?" in small[0].sentence
    assert report(lambda x: 1e8 * room(x)).subjects == {"scale"}
    for unit in (1e-6, 1e6):
        assert not report(lambda x, unit=unit: unit * room(x), settings=replace(SETTINGS, epsilon=0.002 * unit))
    found = report(lambda x: 10.0 * room(x) if x[1] < -9.0 else 100.0 - 1e-3 * x[1])
    assert found.subjects == {"scale"}
    assert "wanted more than epsilon" in found[0].sentence


def test_a_relative_degree_above_one() -> None:
    for h in (lambda x: 1.0 - x[0], HigherOrderBarrier([lambda x: 2.0 - 2.0 * x[0], lambda x: 0.0], [1.0])):
        found = report(h)
        assert "relative degree" in found.subjects
        assert "RolloutBarrier" in str(found)
    late = PendingActions(affine, 3, (0.0,))
    ahead = check_filter(SafetyFilter(late.prediction, [FunctionBarrier(room)], SETTINGS), late.state([0.0, 0.0]))
    assert "relative degree" in ahead.subjects
    assert "does not answer to the action in one tick" in str(ahead)


def test_an_h_that_falls_under_the_backup_is_reported_even_for_a_filter_that_is_switched_off() -> None:
    found = report(settings=replace(SETTINGS, backup_action=(1.0,)))
    assert found.subjects == {"backup"}
    assert "under the backup" in found[0].sentence
    assert not report(settings=replace(SETTINGS, enabled=False))
    assert report(settings=replace(SETTINGS, enabled=False, backup_action=(1.0,))).subjects == {"backup"}


def test_conditions_that_no_action_can_satisfy_or_that_exclude_each_other_are_reported() -> None:
    """Relative degree one, but braking is overrated."""
    found = report(lambda x: float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 16.0 - 0.02 * max(x[1], 0.0)))
    assert "conditions" in found.subjects
    assert "every action tried misses its condition" in str(found)
    # Each can be kept, both cannot: at x = 0 all room is used up by either side.
    both = FunctionBarrier(
        lambda x: np.array([0.5 + x[1] + 0.2 * x[0], 0.5 - x[1] - 0.2 * x[0]]) ** 3, names=("left", "right")
    )
    found = report(both, settings=replace(SETTINGS, epsilon=0.02, eta=0.2), states=np.zeros((1, 2)))
    assert "conditions" in found.subjects or "backup" in found.subjects


@pytest.mark.long
def test_a_backup_out_of_bounds_or_of_another_shape_or_not_the_barriers_own() -> None:
    assert "wanted [-1] to [1]" in report(backup=lambda x: [-3.0])[0].sentence
    assert "finite numbers" in report(backup=lambda x: [0.0] if x is None else [0.0, 0.0])[0].sentence
    with pytest.raises(InputError, match="1 finite numbers, one for each action"):
        report(backup=lambda x: [0.0, 0.0])
    found = report(RolloutBarrier(affine, brake, lambda x: 1.0 - x[0], 40))
    assert found.subjects == {"backup"}
    assert "give the filter backup=barrier.backup" in found[0].sentence


def test_a_horizon_that_ends_before_the_robot_rests() -> None:
    wall = RolloutBarrier(affine, brake, lambda x: 1.0 - x[0], 8)
    found = report(wall, backup=wall.backup)
    assert "horizon" in found.subjects
    assert "after the horizon of 8 ticks" in str(found)


def test_an_obstacle_thinner_than_a_tick() -> None:
    def thin(x: np.ndarray) -> float:
        return float(np.hypot(x[0] - 1.0, x[1]) - 0.1)

    def jumping(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.array(x), np.eye(2)

    limits = FilterSettings(action_low=(-0.5, -0.5), action_high=(0.5, 0.5), eta=0.5, epsilon=0.005)
    states = [[0.0, 0.0], [0.1, 0.3]]
    found = check_filter(SafetyFilter(jumping, [FunctionBarrier(thin)], limits), states)
    assert found.subjects == {"ticks"}
    assert "thinner than a tick's travel" in found[0].sentence
    looking = RolloutBarrier(jumping, (0.0, 0.0), thin, 1)
    assert not check_filter(SafetyFilter(jumping, [looking], limits), states)


def test_a_margin_of_zero_and_a_gradient_that_contradicts_its_h_are_reported() -> None:
    found = report(settings=replace(SETTINGS, epsilon={"obstacle": 0.01}), kind="wall")
    assert found.subjects == {"margin"}
    assert "epsilon = { wall = ... }" in found[0].sentence
    given = SafetyFilter(affine, [FunctionBarrier(room, kind="wall")], replace(SETTINGS, epsilon={"obstacle": 0.01}))
    assert not check_filter(given, STATES, epsilon={"wall": 0.002}), "as in decide, the call's margins come first"
    found = report(gradient=lambda x: [1.0, -0.1])
    assert "gradient" in found.subjects
    assert "got a slope of 1 in entry 0 of the state, wanted -1" in str(found)
    right = report(gradient=lambda x: [-1.0, -(x[1] / 0.8 + 0.1) * (x[1] > 0.0)])
    assert not right


def test_an_error_in_a_users_function_is_reported() -> None:
    found = report(lambda x: 1.0 / 0.0 if x[0] > 0.6 else room(x))
    assert found.subjects == {"failure"}
    assert "ZeroDivisionError" in str(found)


def test_there_is_something_to_check() -> None:
    with pytest.raises(InputError, match="barriers: got none"):
        check_filter(SafetyFilter(affine, [], SETTINGS), [0.0, 0.0])


def rollout(backup: Any) -> RolloutBarrier:
    return RolloutBarrier(lambda x: (0.5 * x, 0.1 * np.eye(1)), backup, first, 5, ["r"])


@pytest.mark.parametrize(("foreign", "reported"), [(False, ["h0"]), (True, ["r"])])
def test_a_condition_that_breaks_is_reported_of_the_right_backup_only(foreign: bool, reported: list[str]) -> None:
    """From 0.5 with -1 to 0.4: a condition of 0.9 x 0.5 + 0.002 is missed, by whichever backup the rollout thinks of.

    But with another one than the filter's, every condition of the rollout is about something that is not done.
    """
    own = [-1.0]
    checked = made(first, rollout([0.5] if foreign else own), backup=lambda x: own)
    near = probe(0.5, h=[0.5, 9.0])
    found = backup_issues(checked, [near], can_stop=True)
    assert [name for issue in found for name in issue.names if name in reported] == reported
    assert all("the same; give the filter" in issue.sentence for issue in found) is foreign
    assert any("misses its condition" in issue.sentence for issue in found) is not foreign
    unasked = backup_issues(checked, [near], can_stop=False)
    assert len(unasked) == foreign, (
        "a robot that cannot stop is not checked for it, but another backup is reported nevertheless"
    )


NAMES = ("a", "b", "c", "d", "e", "f")


def test_the_worst_is_named_first_and_gives_its_sentence() -> None:
    cases = {0: (1.0, "slightly"), 3: (7.0, "badly"), 5: (2.0, "somewhat")}
    assert collect("scale", NAMES, cases) == [FilterIssue("scale", ("d", "f", "a"), "badly")]
    assert collect("scale", NAMES, {}) == []


@pytest.mark.parametrize(
    ("count", "notice"),
    [(0, "scale: x"), (1, "scale (a): x"), (4, "scale (a, b, c, d): x"), (5, "scale (a, b, c, d, ...): x")],
)
def test_an_issue_shows_four_names_and_that_there_are_more(count: int, notice: str) -> None:
    assert str(FilterIssue("scale", NAMES[:count], "x")) == notice


def test_a_report_is_its_issues() -> None:
    issues = [FilterIssue("scale", (), "x"), FilterIssue("margin", ("a",), "y")]
    report = FilterReport(issues, 7)
    assert (list(report), len(report), report[1], report[:1]) == (issues, 2, issues[1], (issues[0],))
    assert (report.subjects, str(report)) == ({"scale", "margin"}, "- scale: x\n- margin (a): y")
    assert not FilterReport([], 7)
    assert str(FilterReport([], 7)) == "No issue at 7 states."
    assert format_vector([1.0, -0.123456]) == "[1, -0.1235]"


def base(x: Any, a: Any, operations: Any) -> list[Any]:
    return [x[0] + PERIOD * a[0], x[1] + PERIOD * a[1], x[2] + PERIOD * a[2]]


CAR = load_model("car")
CAR_SETTINGS = FilterSettings.for_robot("car")
DISCS = car_barriers(CAR_SETTINGS, (0.08, 0.4, 0.12), [[2.0, 0.0, 0.3]], (-9.0, 9.0, -9.0, 9.0))
ASIDE = FunctionBarrier(lambda x: 3.0 - x[1], kind="obstacle", names=("aside",))
WALL = RolloutBarrier(base, np.zeros(3), lambda x, operations: [2.0 - x[0]], 2, ("wall",))
THREE = FilterSettings(action_low=(-1.0,) * 3, action_high=(1.0,) * 3, eta=0.2, epsilon=0.0)


@pytest.mark.parametrize(
    ("safe", "states", "reason"),
    [
        (SafetyFilter.for_model(CAR, CAR_SETTINGS, DISCS), 4, ""),
        (SafetyFilter.for_model(CAR, CAR_SETTINGS, [*DISCS, ASIDE]), 4, "aside: its h is a function"),
        (SafetyFilter(affine, [FunctionBarrier(room)], SETTINGS), 2, "the model is a function without the parameter"),
        (SafetyFilter(WALL.prediction, [WALL], THREE), 3, "it has 3 actions, and C decides about one or two"),
    ],
)
def test_the_check_says_when_python_decides_and_why(safe: SafetyFilter, states: int, reason: str) -> None:
    latent = CAR.latent if states == 4 else None
    notes = check_filter(safe, np.zeros((1, states)), latent=latent, ticks=2).notes
    assert len(notes) == bool(reason)
    assert all(note.startswith("Note (decision): made by Python instead of compiled C: ") for note in notes)
    assert reason in "".join(notes)
