"""The parts of a filter's check one by one, on a point that moves by a tenth of its action in a tick."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from tests.safety.checked import Values, first, made, probe

from safedpa.errors import InputError
from safedpa.safety import FunctionBarrier, RolloutBarrier, Verdict, check_filter
from safedpa.safety.checks.backup import backup_issues, horizon_issues
from safedpa.safety.checks.barriers import condition_issues, gradient_issues, margin_issues, scale_issues, tick_issues
from safedpa.safety.checks.probes import FilterUnderTest, collect_probes
from safedpa.safety.verdict import Status, resting_verdict

# what is asked of a filter without a verdict


def test_thresholds_and_residuals_follow_worked_examples_and_the_latent_is_the_models() -> None:
    checked = made(first, lambda x: 5.0 - x[0], epsilon=0.002, eta=0.1)
    np.testing.assert_allclose(checked.threshold, [0.02, 0.02])
    np.testing.assert_allclose(checked.tolerance(np.array([3.0, -4e6])), [0.0001 + 3e-9, 0.0001 + 4e-3])
    # From 3 with a = -1 to 2.9: 2.9 - 0.9 x 3 - 0.002.
    np.testing.assert_allclose(made(first).residual(np.array([3.0]), np.array([-1.0])), [0.198])
    checked = made(first, model=lambda x, z: (x + z, 0.1 * np.eye(1)), latent=np.array([0.5]))
    np.testing.assert_allclose(checked.next_state(np.array([3.0]), np.array([-1.0])), [3.4])


@pytest.mark.parametrize(("actions", "corners"), [(1, 2), (2, 4), (4, 16), (5, 16)])
def test_corners_and_the_middle(actions: int, corners: int) -> None:
    *found, middle = made(first, actions=actions, model=lambda x: (x, np.ones((1, actions)))).corners()
    assert len({tuple(one) for one in found}) == len(found) == corners
    assert all(set(one) <= {-1.0, 2.0} for one in found)
    assert (found[0] == -1.0).all()
    assert (found[-1] == 2.0).all()
    assert (middle == 0.5).all()


class Open:
    """A filter that lets every nominal action pass, or none beyond a state."""

    def __init__(self, checked: FilterUnderTest, end: float = np.inf) -> None:
        self.settings, self.tools, self.end = checked.safe.settings, checked.safe.tools, end
        self.asked: list[tuple[float, float]] = []
        self.beyond = Status.relaxed

    def decide(self, state: Values, nominal: Values, latent: Any, **_: Any) -> Verdict:
        self.asked.append((float(state[0]), float(nominal[0])))
        status = Status.passed if state[0] < self.end else self.beyond
        return replace(resting_verdict(np.array(nominal), ""), status=status)


def opened(end: float = np.inf) -> tuple[FilterUnderTest, Open]:
    checked = made(lambda x: 100.0 - x[0])
    safe = Open(checked, end)
    return FilterUnderTest(safe, checked.barriers, checked.margins, None), safe  # type: ignore[arg-type]


def test_sixty_states_are_probed_and_twelve_drives_from_them() -> None:
    checked, safe = opened()
    found = collect_probes(checked, [np.array([float(at)]) for at in range(70)], 16, 0)
    assert [one.state[0] for one in found[:60]] == list(range(60))
    assert len(found) == 60 + 12 * 2, "of each drive the eighth tick and the sixteenth"
    assert len(safe.asked) == 12 * 16
    starts = [safe.asked[16 * drive][0] for drive in range(12)]
    assert starts == list(range(12))
    nominal_actions = [[nominal for _, nominal in safe.asked[16 * drive : 16 * drive + 16]] for drive in range(12)]
    assert (set(nominal_actions[0]), set(nominal_actions[1])) == ({-1.0}, {2.0}), (
        "first every extreme action to the end"
    )
    assert {nominal for drive in nominal_actions[2:] for nominal in drive} == {-1.0, 2.0}
    pushed = [one.state[0] for one in found[60:64]]
    np.testing.assert_allclose(pushed, [0.0 - 0.7, 0.0 - 1.5, 1.0 + 1.4, 1.0 + 3.0])


def test_nominal_actions_are_held_for_some_ticks_and_come_from_the_seed() -> None:
    runs = []
    for seed in (0, 0, 1):
        checked, safe = opened()
        collect_probes(checked, [np.array([0.0])], 200, seed)
        nominal_actions = [nominal for _, nominal in safe.asked[400:]]
        runs.append(nominal_actions)
        changes = [
            at for at in range(1, len(nominal_actions)) if nominal_actions[at] != nominal_actions[at - 1] and at % 200
        ]
        gaps = [b - a for a, b in pairwise(changes) if a // 200 == b // 200]
        assert min(gaps) >= 3
    assert runs[0] == runs[1] != runs[2]


def test_a_drive_ends_where_no_action_keeps_every_condition() -> None:
    checked, safe = opened(end=0.75)
    found = collect_probes(checked, [np.array([0.0])], 40, 0)
    up = [one for one in found[1:] if one.state[0] >= 0.75]
    assert up
    assert max(one.state[0] for one in found) < 0.75 + 0.2 + 1e-9
    assert not [state for state, _ in safe.asked if state >= 0.95 + 1e-9]


def test_a_filter_that_decides_nothing_is_refused_at_the_first_state_and_ends_a_drive_later() -> None:
    checked, safe = opened(end=0.75)
    safe.beyond = Status.fallback
    assert max(one.state[0] for one in collect_probes(checked, [np.array([0.0])], 40, 0)) >= 0.75
    with pytest.raises(InputError, match="the filter decides nothing at"):
        collect_probes(checked, [np.array([0.8])], 40, 0)


def test_drives_begin_inside_where_some_state_is() -> None:
    checked = made(first)
    found = collect_probes(checked, [np.array([0.01]), np.array([5.0])], 8, 0)
    assert [one.inside for one in found[:2]] == [False, True]
    assert all(one.state[0] > 1.0 for one in found[2:])
    outside = collect_probes(checked, [np.array([0.01])], 8, 0)
    assert len(outside) > 1, "where none is, they begin there all the same"


def test_what_is_known_at_a_state() -> None:
    (one, *_) = collect_probes(made(first, lambda x: 4.0 - 2.0 * x[0]), [np.array([1.0])], 1, 0)
    np.testing.assert_allclose(one.h, [1.0, 2.0])
    np.testing.assert_allclose(
        one.residuals, [[0.9 - 0.902, 2.2 - 1.802], [1.2 - 0.902, 1.6 - 1.802], [1.05 - 0.902, 1.9 - 1.802]]
    )
    np.testing.assert_allclose(one.moved, [0.2])
    np.testing.assert_allclose(one.reached, [0.3, 0.6])
    assert one.inside
    assert one.is_feasible


def test_a_kind_without_a_margin() -> None:
    parts = [FunctionBarrier(first, names=("a",), kind="one"), FunctionBarrier(first, names=("b",), kind="two")]
    for epsilon, kinds in (
        ({"one": 0.1, "two": 0.0}, ["two"]),
        ({"one": 0.1, "two": 0.2}, []),
        ({"default": 0.0}, ["one", "two"]),
    ):
        found = margin_issues(made(*parts, epsilon=epsilon), [])
        assert [issue.subject for issue in found] == ["margin"] * len(kinds)
        assert [f"'{kind}'" in issue.sentence for kind, issue in zip(kinds, found, strict=True)] == [True] * len(kinds)


@pytest.mark.parametrize(
    ("epsilon", "h", "reached", "notice"),
    [
        (0.1, (0.5, 1.5), 0.3, ""),
        (0.1, (0.5, 1.0), 0.3, ""),
        (0.1, (0.5, 0.9), 0.3, "got h of 0.9 at most (it varies by 0.4) over 2 states"),
        (0.0, (-5.0, -4.0), 0.0, ""),
        (0.1, (0.5, 1.5), 0.1, ""),
        (0.1, (0.5, 1.5), 0.09, "got actions that change h by 0.09 in one tick at most"),
        (0.1, (0.5, 1.5), 0.0, "got actions that change h by 0 in one tick at most"),
        (0.1, (0.5, 1.5), 0.99e5, ""),
        (0.1, (0.5, 1.5), 1.01e5, "got epsilon = 0.1 where the actions change h by 1.01e+05"),
    ],
)
def test_units_that_do_not_fit(epsilon: float, h: tuple[float, float], reached: float, notice: str) -> None:
    found = scale_issues(made(first, epsilon=epsilon), [probe(0.0, h=h[0]), probe(1.0, h=h[1], reached=reached)][::-1])
    if reached == 0.3:
        assert found == scale_issues(made(first, epsilon=epsilon), [probe(0.0, h=h[0]), probe(1.0, h=h[1])])
    found = scale_issues(
        made(first, epsilon=epsilon), [probe(0.0, h=h[0], reached=reached), probe(1.0, h=h[1], reached=0.0)]
    )
    assert [issue.subject for issue in found] == ["scale"] * bool(notice)
    assert notice in "".join(issue.sentence for issue in found)


def test_the_unit_that_is_furthest_off_is_named_first() -> None:
    checked = made(first, first, first, epsilon=0.1)
    found = scale_issues(checked, [probe(0.0, h=[2.0] * 3, reached=[0.05, 1e-9, 1e7])])
    assert found[0].names == ("h1", "h2", "h0"), "eight and a half decades, eight, a half"


@pytest.mark.parametrize(
    ("gradient", "wrong"),
    [((2.0, 3.0), ""), ((2.01, 3.0), ""), ((2.2, 3.0), "2.2 in entry 0"), ((2.0, -3.0), "-3 in entry 1")],
)
def test_a_gradient_that_its_own_h_contradicts(gradient: tuple[float, float], wrong: str) -> None:
    barrier = FunctionBarrier(lambda x: 2.0 * x[0] + 3.0 * x[1], lambda x: np.array(gradient), ("h",))
    probes = [probe(at, 2.0 * at, h=8.0 * at, moved=[0.1, 0.2]) for at in (0.0, 1.0, 2.0)]
    found = gradient_issues(made(barrier, actions=2), probes)
    assert [issue.subject for issue in found] == ["gradient"] * bool(wrong)
    if wrong:
        assert f"got a slope of {wrong} of the state" in found[0].sentence
        assert "wrong at 3 of 3 states" in found[0].sentence


def test_a_gradient_between_the_slopes_of_both_sides_is_right_at_a_kink() -> None:
    for slope, right in ((-1.0, True), (0.3, True), (1.0, True), (1.5, False), (-1.5, False)):
        barrier = FunctionBarrier(lambda x: abs(x[0]), lambda x, slope=slope: np.array([slope]), ("h",))  # type: ignore[misc]
        assert (gradient_issues(made(barrier), [probe(0.0, h=0.0)] * 3) == []) is right


def test_a_gradient_wrong_at_few_states_is_a_kink() -> None:
    """A tenth of the states, and two of them."""
    for count, states, reported in ((1, 3, False), (2, 3, True), (2, 20, True), (2, 21, False), (3, 21, True)):
        barrier = FunctionBarrier(
            lambda x: x[0],
            lambda x, count=count: np.array([5.0 if x[0] < count - 0.5 else 1.0]),
            ("h",),  # type: ignore[misc]
        )
        found = gradient_issues(made(barrier), [probe(float(at), h=float(at)) for at in range(states)])
        assert bool(found) is reported


def test_an_entry_that_nothing_moves_is_not_judged_and_a_gradient_of_a_constant_has_to_be_zero() -> None:
    barrier = FunctionBarrier(lambda x: x[0] + x[1], lambda x: np.array([1.0, 99.0]), ("h",))
    assert gradient_issues(made(barrier, actions=2), [probe(0.0, 0.0, h=0.0, moved=[0.1, 0.0])] * 3) == []
    barrier = FunctionBarrier(lambda x: 7.0, lambda x: np.array([0.1]), ("h",))
    assert gradient_issues(made(barrier), [probe(0.0, h=7.0)] * 3)


def wall(width: float) -> Callable[[Values], float]:
    """Low about 0.5 and high elsewhere."""
    return lambda x: float(1.0 - 3.0 * (abs(x[0] - 0.5) < 0.5 * width) - 0.01 * x[0])


@pytest.mark.parametrize(("width", "reported"), [(0.05, True), (0.5, False)])
def test_a_hazard_thinner_than_a_tick_is_reported(width: float, reported: bool) -> None:
    """It goes down with h by 0.25 to the right in a tick: over what is narrower it jumps."""
    checked = made(wall(width), model=lambda x: (x + 0.2, 0.05 * np.eye(1)))
    found = tick_issues(checked, [probe(0.0, h=1.0)])
    assert [issue.subject for issue in found] == ["ticks"] * reported
    if reported:
        assert "at two ticks" in found[0].sentence


def test_a_fall_of_the_threshold_is_none() -> None:
    for depth, reported in ((0.9, False), (1.2, True)):
        checked = made(
            lambda x, depth=depth: 0.3 * depth if abs(x[0] - 0.375) > 0.06 else 0.0,
            epsilon=0.03,
            model=lambda x: (x + 0.25, 0.01 * np.eye(1)),
        )  # type: ignore[misc]
        assert bool(tick_issues(checked, [probe(0.0, h=0.3 * depth)])) is reported


def test_what_dips_is_named_among_several_values_and_outside_nothing_is_followed() -> None:
    flat = FunctionBarrier(lambda x: [5.0, 6.0], names=("high", "higher"))
    checked = made(flat, wall(0.05), model=lambda x: (x + 0.2, 0.05 * np.eye(1)))
    (issue,) = tick_issues(checked, [probe(-0.3, h=[5.0, 6.0, float(checked.h(np.array([-0.3]))[2])])])
    assert issue.names == ("h1",)
    checked = made(wall(0.05), model=lambda x: (x + 0.2, 0.05 * np.eye(1)))
    assert tick_issues(checked, [probe(0.0, h=-0.1)]) == []


def double(x: Values) -> tuple[Values, Values]:
    return np.array([x[0] + 0.1 * x[1], x[1]]), np.array([[0.005], [0.1]])


def lagging(x: Values) -> tuple[Values, Values]:
    return np.array([x[0] + 0.1 * x[1], x[1]]), np.array([[0.0], [0.1]])


def test_an_h_that_answers_with_its_time_squared() -> None:
    broken = probe(0.5, -1.0, h=0.5, residuals=[[-0.1], [-0.05]], kept=False)
    found = condition_issues(made(first, model=double), [broken])
    assert [issue.subject for issue in found] == ["relative degree"]
    assert "answers with its time to the 2 at any of 1 states" in found[0].sentence
    late = condition_issues(made(first, model=lagging), [broken])
    assert "does not answer to the action in one tick at any of 1 states" in late[0].sentence


def test_a_condition_that_no_action_can_satisfy_is_reported() -> None:
    stuck = [
        probe(0.5, h=0.5, residuals=[[-0.3], [-0.1]], kept=False),
        probe(0.7, h=0.7, residuals=[[-0.2], [-0.15]], kept=False),
    ]
    (found,) = condition_issues(made(first), stuck)
    assert found.subject == "conditions"
    assert found.names == ("h0",)
    assert (
        "got h = 0.7 at [0.7], from which every action tried misses its condition by 0.15 or more (2 such"
        in found.sentence
    )


def test_conditions_that_exclude_each_other() -> None:
    apart = probe(0.5, h=[0.5, 0.5], residuals=[[0.1, -0.2], [-0.2, 0.1]], kept=False)
    (found,) = condition_issues(made(first, lambda x: 1.0 - x[0]), [apart])
    assert (found.subject, found.names) == ("conditions", ())
    assert "keeps all of them together at 1 states" in found.sentence


@pytest.mark.parametrize(("inside", "kept"), [(False, False), (True, True), (False, True)])
def test_states_outside_or_kept_are_no_issue(inside: bool, kept: bool) -> None:
    one = probe(0.5, h=0.5, residuals=[[-0.3], [-0.1]], inside=inside, kept=kept)
    assert condition_issues(made(first), [one]) == []


@pytest.mark.parametrize(
    ("backup", "notice"),
    [
        (lambda x: [-1.0 - 1e-10], ""),
        (lambda x: [2.0 + 1e-10], ""),
        (lambda x: [-1.0 - 1e-6], "got [-1] at [1], wanted [-1] to [2]"),
        (lambda x: [2.0 + 1e-6], "got [2] at [1]"),
        (lambda x: [0.0, 0.0], "wanted (1,) finite numbers"),
        (lambda x: [np.nan], "wanted (1,) finite numbers"),
        (lambda x: 0.0, "wanted (1,) finite numbers"),
    ],
)
def test_a_backup_is_an_action_within_its_bounds(backup: Callable[[Any], Any], notice: str) -> None:
    checked = made(first, backup=lambda x: backup(x) if x[0] == 1.0 else [0.0])  # else it is refused when it is given
    found = backup_issues(checked, [probe(0.0), probe(1.0)], can_stop=False)
    assert [issue.subject for issue in found] == ["backup"] * bool(notice)
    assert notice in "".join(issue.sentence for issue in found)


def test_without_a_backup_it_is_the_settings_action() -> None:
    assert made(first).backup(np.zeros(1)) == [0.0]


def test_a_backup_under_which_conditions_break() -> None:
    """It goes down by 0.1 a tick: from 0.5 a condition of 0.9 x 0.5 + 0.002 is missed by 0.052, from 2 none is."""
    checked = made(first, lambda x: 9.0 + x[0], backup=lambda x: [-1.0])
    near, far, out = probe(0.5, h=[0.5, 9.5]), probe(2.0, h=[2.0, 11.0]), probe(0.3, h=[0.3, 9.3], inside=False)
    assert backup_issues(checked, [far, out], can_stop=True) == []
    assert backup_issues(checked, [near], can_stop=False) == []
    (found,) = backup_issues(checked, [far, near, probe(0.6, h=[0.6, 9.6]), out], can_stop=True)
    assert (found.subject, found.names) == ("backup", ("h0",))
    assert "misses its condition by 0.052 under the backup, from h = 0.5 at [0.5]" in found.sentence
    slight = made(first, epsilon=0.02, backup=lambda x: [-1.0])
    assert backup_issues(slight, [probe(1.1901, h=1.1901)], can_stop=True) == [], (
        "missed by a twentieth of epsilon: slight"
    )
    assert backup_issues(slight, [probe(1.189, h=1.189)], can_stop=True)


def rollout(backup: Any, horizon: int, names: Sequence[str] = ("r",)) -> RolloutBarrier:
    return RolloutBarrier(lambda x: (0.5 * x, 0.1 * np.eye(1)), backup, first, horizon, names)


def test_a_rollout_of_another_backup() -> None:
    part = rollout([-0.5], 5)
    for own, reported in (([-0.5], False), ([-0.5 + 1e-10], False), ([-0.4], True)):
        found = backup_issues(
            made(first, part, backup=lambda x, own=own: own), [probe(1.0), probe(2.0)], can_stop=False
        )  # type: ignore[misc]
        assert bool(found) is reported
    assert (found[0].names, len(found)) == (("r",), 1)
    assert "got [-0.4] from the filter's backup and [-0.5] from the barrier's at [1]" in found[0].sentence


def test_a_horizon_that_ends_while_h_falls() -> None:
    """x halves in every tick: after 2 of them from 8 it is at 2, and falls by 1.5 in the next two."""
    checked = made(first, rollout([0.0], 2))
    (found,) = horizon_issues(checked, [probe(8.0, h=[8.0, 2.0])])
    assert (found.subject, found.names) == ("horizon", ("r",))
    assert "falls by 1.5 after the horizon of 2 ticks from [8]" in found.sentence
    assert horizon_issues(checked, [probe(8.0, h=[8.0, 0.019])]) == [], "outside h >= epsilon / eta of its own"
    assert horizon_issues(checked, [probe(8.0, h=[0.0, 2.0])]), "whatever the others are"
    assert horizon_issues(made(rollout([0.0], 40)), [probe(8.0, h=8.0)]) == []


def test_ticks_and_seed_are_the_drives() -> None:
    checked = made(first)
    few, many = check_filter(checked.safe, [5.0], ticks=8), check_filter(checked.safe, [5.0], ticks=16)
    assert (few.states, many.states) == (1 + 12, 1 + 24)
    assert check_filter(checked.safe, [5.0]).states == 1 + 12 * 7
