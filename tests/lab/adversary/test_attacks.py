"""The attacks count what is wrong with a filter, whatever it is: planted faults make their counts rise."""

import json
import sys
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.lab.adversary.problems import answer_with, found, measured

from safedpa.safety import SafetyFilter, Status, Verdict
from safedpa_lab.experiments.adversary import peers
from safedpa_lab.experiments.adversary.attack import Result, Row
from safedpa_lab.experiments.adversary.bad_inputs import BadInputs, two_threads
from safedpa_lab.experiments.adversary.bends import BENT_SHAPES, Bends, BentProblem, bent_answer, bent_problem
from safedpa_lab.experiments.adversary.car_grid import CarGrid, odd_question
from safedpa_lab.experiments.adversary.linear.judge import LinearJudge
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem, random_problem
from safedpa_lab.experiments.adversary.mirrors import MIRRORS, Mirrors
from safedpa_lab.experiments.adversary.peer_filters import PEERS
from safedpa_lab.experiments.adversary.peers import OWN, PEER_PACKAGES, Peers, peer_problems
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_lab.experiments.adversary.scales import Scales, Units, drive
from safedpa_lab.experiments.adversary.systems import SYSTEMS, Systems

Planted = Callable[[Callable[[Callable[[Verdict, object], Verdict]], None]], None]


@pytest.fixture(scope="module")
def clean() -> dict[str, Row]:
    """What the programs count where nothing is planted."""
    return measured(Programs())


def planted_by(patch):
    """plant(change), until the ``patch`` is undone."""

    def planted(change):
        original = SafetyFilter.decide

        def decide(self, state, nominal, *others, **known):
            return change(original(self, state, nominal, *others, **known), nominal)

        patch.setattr(SafetyFilter, "decide", decide)

    return planted


@pytest.fixture
def plant(monkeypatch):
    """Changes every verdict before it is returned: ``plant(lambda verdict, nominal action: ...)``."""
    return planted_by(monkeypatch)


@pytest.fixture(scope="module")
def all_passed() -> Result:
    """What the programs count behind a filter that passes everything."""
    with pytest.MonkeyPatch.context() as patch:
        planted_by(patch)(passes_everything)
        return found(Programs())


def frozen(action):
    taken = np.array(action, dtype=np.float64)
    taken.setflags(write=False)
    return taken


def passes_everything(verdict, nominal):
    """What a filter that is switched off and lies about it would say."""
    return replace(verdict, action=frozen(np.asarray(nominal, dtype=np.float64)), status=Status.passed)


@pytest.mark.long
def test_the_programs_notice_a_filter_that_goes_not_all_the_way(clean, plant):
    def a_little_less(verdict, nominal):
        """A correction that goes only 99.9 % of the way, as a tolerance would allow it."""
        moved = verdict.action + 1e-3 * (np.asarray(nominal) - verdict.action)
        return replace(verdict, action=frozen(moved)) if verdict.status is Status.corrected else verdict

    before = clean["passed or corrected, condition broken"].measured
    plant(a_little_less)
    after = measured(Programs())["passed or corrected, condition broken"].measured
    assert after > before + 50


def test_the_programs_notice_actions_that_are_swapped_for_the_nominal_action(all_passed):
    counted = {row.what: row for row in all_passed.rows}
    assert counted["passed or corrected, condition broken"].measured > 200
    assert counted["passed or corrected, predicted h < 0"].measured > 100
    assert counted["h < 0 now, and not reported (or reported wrongly)"].measured > 25
    assert counted["action out of bounds"].measured > 100


@pytest.mark.long
def test_the_programs_notice_corrections_that_go_too_far(clean, plant):
    def middle(verdict, nominal):
        if verdict.status is not Status.passed:
            return verdict
        return replace(verdict, status=Status.corrected, action=frozen(0.999 * verdict.action))

    before = clean["corrected further than needed"].measured
    plant(middle)
    assert measured(Programs())["corrected further than needed"].measured > before + 5


def test_the_programs_notice_an_infeasible_answer_that_is_not_the_least_unsafe(plant):
    def other_end(verdict, nominal):
        if verdict.status in (Status.passed, Status.corrected):
            return verdict
        return replace(verdict, status=Status.relaxed, action=frozen(-verdict.action + 2.0 * np.asarray(nominal)))

    plant(other_end)
    found = measured(Programs())
    assert found["within 1 % of the least-violation"].measured < 60.0
    assert found["h < 0 predicted, though h >= 0 attainable"].measured > 5
    assert found["not corrected, though an action keeps all"].of is not None


def test_the_drive_at_scale_one_stops_before_the_wall_and_a_deaf_filter_does_not(plant):
    assert drive(Units()).furthest < 1.0
    plant(passes_everything)
    assert drive(Units()).furthest > 1.0


@pytest.mark.long
def test_other_units_of_a_filter_with_an_absolute_tolerance_are_noticed(plant):
    """Planted: the nominal action is believed whenever h is small, as an absolute tolerance would have it."""

    def absolute(verdict, nominal):
        if verdict.status is Status.corrected and abs(verdict.h_now) < 1e-4:
            return passes_everything(verdict, nominal)
        return verdict

    plant(absolute)
    found = measured(Scales())
    assert found["h: furthest point"].measured > 1.0
    assert found["h: drives with other statuses"].measured > 0
    assert found["furthest point at scale 1"].held


def test_the_car_grid_notices_broken_conditions(plant):
    plant(passes_everything)
    found = measured(CarGrid())
    assert found["car: largest break of a condition, in scales"].measured > 0.01
    assert found["car: passed or corrected, predicted h < 0"].measured > 0


def test_odd_scenes_have_their_stated_oddity():
    sizes = [len(odd_question(1, number).obstacles) for number in range(5)]
    assert (sizes[3], sizes[1] % 3, odd_question(1, 2).obstacles[0, 2]) == (60, 0, 1000.0)
    body = odd_question(1, 0)
    assert np.array_equal(body.obstacles[-1, :2], body.state[:2])
    assert (odd_question(1, 4).obstacles[:, 2] == 0.0).all()


@pytest.mark.long
def test_the_systems_crash_behind_a_filter_that_passes_everything(plant):
    def deaf(verdict, nominal):
        action = np.where(np.isfinite(nominal), nominal, 0.0)
        return replace(verdict, action=frozen(action), status=Status.passed)

    plant(deaf)
    found = measured(Systems())
    crashed = [row for what, row in found.items() if what.endswith("episodes with h < 0")]
    assert len(crashed) == len(SYSTEMS)
    assert sum(row.measured > 0 for row in crashed) >= 8
    assert not any(row.held for what, row in found.items() if what.endswith("largest break, in scales"))


def test_bad_inputs_are_counted(plant):
    def believes(verdict, nominal):
        return replace(verdict, status=Status.passed)

    plant(believes)
    found = measured(BadInputs())
    count = found["an unsafe nominal action passed"].of
    assert count is not None
    assert count > 120
    assert found["an unsafe nominal action passed"].measured > 100
    assert found["bad values believed"].measured > 90


def test_two_threads_that_get_each_others_answers_are_noticed(monkeypatch):
    """Planted: every tenth answer is that of the other scene."""
    original, calls = SafetyFilter.decide, [0]
    others: list[Verdict] = []

    def decide(self, *arguments, **known):
        verdict = original(self, *arguments, **known)
        calls[0] += 1
        others.append(verdict)
        return (
            others[0 if verdict.status is others[1].status else 1] if calls[0] > 2 and calls[0] % 10 == 0 else verdict
        )

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    mixed, _, count = two_threads(200)
    assert count == 400
    assert mixed > 10


def test_a_figure_held_if_it_is_within_its_limits():
    assert Row("", 0.0, most=0).held is True
    assert Row("", 1.0, most=0).held is False
    assert Row("", 0.5, least=0.4, most=0.6).held is True
    assert Row("", 0.3, least=0.4, most=0.6).held is False
    assert Row("", 99.0, least=99.9).held is False
    assert Row("", float("nan"), most=1).held is False
    assert Row("", 3.0).held is None
    assert Row("", 0.0, of=0, most=0).held is None
    assert Row("", 0.0, least=0.4, most=0.6, unit="m").asked == "0.4 to 0.6 m"
    assert Row("", 0.0, least=2).asked == "at least 2"


def bent(h, nominal=1.0, actions=1, eta=0.5, epsilon=0.0, units=(1.0, 1.0)):
    """At the origin; the first action moves x, the second y, each by itself."""

    def moved(a):
        return np.pad(a, ((0, 0), (0, 2 - a.shape[1])))

    return BentProblem("by hand", np.zeros(2), moved, h, actions, np.full(actions, nominal), eta, epsilon, units)


def wall(x):
    """h = 0.4 - x: with eta 0.5 the furthest is x = 0.2."""
    return 0.4 - x[:, :1]


@pytest.mark.parametrize("units", [(1.0, 1.0), (1e-5, 1e4)])
def test_a_wall_is_kept_in_all_units(units):
    problem = bent(wall, units=units)
    verdict = problem.decide()
    assert verdict.status is Status.corrected
    assert verdict.action[0] / units[1] == pytest.approx(0.2, abs=1e-6)
    answer = bent_answer(problem)
    assert answer.broken == pytest.approx(0.0, abs=1e-9)
    assert answer.excess == pytest.approx(0.0, abs=2e-3)  # the grid's own steps


def test_a_broken_condition_is_measured_in_scales(monkeypatch):
    """With a scale of 2, by which the action can change h."""
    answer_with(monkeypatch, "passed", [0.3])
    found = bent_answer(bent(wall))
    assert found.broken == pytest.approx(0.1 / 2.0)
    assert not found.below
    answer_with(monkeypatch, "passed", [0.5])
    assert bent_answer(bent(wall)).below


def test_a_correction_that_goes_too_far_is_measured_in_ranges(monkeypatch):
    answer_with(monkeypatch, "corrected", [-1.0])
    assert bent_answer(bent(wall)).excess == pytest.approx(0.6, abs=2e-3)
    assert bent_answer(bent(lambda x: 0.4 - 0.0 * x[:, :1], epsilon=1.0)).excess is None, "no action keeps it"


@pytest.mark.parametrize(
    ("status", "lift", "action", "missed", "needless"),
    [
        ("relaxed", 0.5, 0.0, True, False), ("relaxed", 0.5, 0.9, True, True), ("fallback", 0.5, -0.9, True, True),
        ("violated", 0.5, 0.9, False, False), ("relaxed", -0.25, 0.9, False, False),
        ("relaxed", 0.006, 0.9, True, True), ("relaxed", 0.002, 0.9, True, True),
    ],
)  # fmt: skip
def test_an_answer_misses_what_a_single_point_of_the_grid_keeps(status, lift, action, missed, needless, monkeypatch):
    """h = lift + a and lift - a: of points 0.002 apart those from -lift / 2 to lift / 2 satisfy both conditions."""
    answer_with(monkeypatch, status, [action])
    problem = bent(lambda x: np.concatenate([lift + x[:, :1], lift - x[:, :1]], axis=1))
    found = bent_answer(problem, 7)
    assert (found.number, found.status, found.missed, found.needless) == (7, status, missed, needless)
    own = (lift - abs(action)) / 2.0
    assert found.shortfall == pytest.approx(max(0.0, lift / 2.0 - own))


def test_a_number_always_draws_the_same_problem():
    for number in range(len(BENT_SHAPES)):
        one, other = bent_problem(3, number), bent_problem(3, number)
        grid = np.random.default_rng(number).uniform(-0.7, 0.7, (20, one.actions))
        np.testing.assert_array_equal(one.h(one.moved(grid)), other.h(other.moved(grid)))
        np.testing.assert_array_equal(one.nominal, other.nominal)


def test_bent_problems_notice_a_filter_that_passes_everything(monkeypatch):
    original = SafetyFilter.decide

    def deaf(self, state, nominal, **known):
        verdict = original(self, state, nominal, **known)
        return replace(verdict, action=np.clip(nominal, self.settings.low, self.settings.high), status=Status.passed)

    before = measured(Bends())
    monkeypatch.setattr(SafetyFilter, "decide", deaf)
    after = found(Bends())
    rows = {row.what: row for row in after.rows}
    for shape in BENT_SHAPES:
        what = f"{shape}: largest break of a condition, in scales"
        assert rows[what].measured > max(0.01, before[what].measured)
    assert after.worst[0]["fault"] == "condition broken"


@pytest.mark.parametrize("name", MIRRORS)
def test_the_reference_says_the_same_of_both_forms(name):
    """The mirrors themselves are right: what can be attained, and where, does not depend on the form."""
    compared = 0
    for number in range(0, 240, 6):
        problem = random_problem(11, number)
        if problem.shape in ("boundary", "whole", "meeting", "parallel", "violated"):
            continue
        other, back = MIRRORS[name](problem, np.random.default_rng(number))
        before, after = LinearJudge(problem).nearest(), LinearJudge(other).nearest()
        assert (before is None) == (after is None)
        if before is not None and after is not None:
            weights = np.sqrt(problem.weights / problem.weights.max())
            apart = weights * (back(after.action) - before.action) / (problem.high - problem.low)
            assert np.abs(apart).max() < 1e-5
            compared += 1
    assert compared > 8


@pytest.mark.long
def test_a_filter_that_prefers_the_first_barrier_is_noticed(monkeypatch):
    """Planted: all barriers but the first are forgotten."""

    def decide(self):
        return self.filter().decide(self.state, nominal=self.nominal, barriers=self.barriers()[:1])

    assert measured(Mirrors(), 2)["barriers in another order: other answers"].held
    monkeypatch.setattr(LinearProblem, "decide", decide)
    after = found(Mirrors(), 2)
    assert {row.what: row.measured for row in after.rows}["barriers in another order: other answers"] > 15
    assert after.worst[0]["apart"] > 1e-6 or len(set(after.worst[0]["statuses"])) == 2


def test_a_filter_that_remembers_the_last_action_is_noticed(monkeypatch):
    original = SafetyFilter.decide

    def decide(self, state, nominal, *others, **known):
        verdict = original(self, state, nominal, *others, **known)
        last = getattr(self, "planted", verdict.action)
        self.planted = verdict.action
        if verdict.status is not Status.corrected or np.shape(last) != np.shape(verdict.action):
            return verdict
        return replace(verdict, action=0.9 * verdict.action + 0.1 * last)

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    rows = measured(Mirrors(), 2)
    assert rows["a filter that answered others before: other answers"].measured > 5
    assert rows["barriers in another order: other answers"].held


def test_a_filter_that_prefers_positive_actions_is_noticed(monkeypatch):
    original = SafetyFilter.decide

    def decide(self, state, nominal, *others, **known):
        verdict = original(self, state, nominal, *others, **known)
        moved = verdict.action + 1e-4 * (self.settings.high - verdict.action)
        return replace(verdict, action=moved) if verdict.status is Status.corrected else verdict

    monkeypatch.setattr(SafetyFilter, "decide", decide)
    assert measured(Mirrors(), 2)["actions turned round: other answers"].measured > 5


def rows(found):
    return {row.what: row for row in found[1]}


@pytest.fixture
def scripted(monkeypatch, tmp_path):
    """Puts a script in the place of the peers'."""

    def use(body):
        script = f"import json, sys\nproblems = json.load(sys.stdin)['problems']\n{body}\n"
        (tmp_path / "peer_filters.py").write_text(script)
        monkeypatch.setattr(peers, "__file__", str(tmp_path / "peers.py"))
        monkeypatch.setattr(peers, "PEER_PACKAGES", {"planted": "json"})

    return use


def test_every_peer_that_is_asked_has_a_filter():
    assert set(PEERS) == set(PEER_PACKAGES)


def test_a_peer_that_is_not_installed_is_named_as_missing(monkeypatch):
    monkeypatch.setattr(peers, "PEER_PACKAGES", {"planted": "no_such_package_anywhere"})
    (row,) = Peers().work(("planted", 0, 2))[1]
    assert row.what == "planted: no_such_package_anywhere is not installed here"
    assert row.held is None


def test_the_answers_of_the_reference_are_safe(scripted, monkeypatch):
    problems = peer_problems(3, 20, False)
    best = [LinearJudge(problem).nearest() for problem in problems]
    answers = [{"action": None if item is None else item.action.tolist(), "notice": ""} for item in best]
    scripted(f"print({json.dumps(answers)!r})")
    monkeypatch.setattr(peers, "peer_problems", lambda *_: problems)
    found = rows(Peers((sys.executable,)).work(("planted", 3, 20)))
    assert found["planted, at scale 1: unsafe action, and not a word"].measured == 0
    assert found["planted, at scale 1: no action at all"].measured == sum(item is None for item in best)


def test_a_failing_peer_is_reported(scripted):
    scripted("raise SystemExit('no licence')")
    (row,) = Peers((sys.executable,)).work(("planted", 0, 2))[1]
    assert row.what == "planted: failed: no licence"


def test_own_answers_are_judged_like_the_others(plant):
    what = "safedpa, at scale 1: unsafe action, and not a word"
    assert rows(Peers().work((OWN, 3, 20)))[what].measured == 0
    plant(lambda verdict, nominal: replace(verdict, action=frozen(np.clip(nominal, -1.0, 1.0)), status=Status.passed))
    after = rows(Peers().work((OWN, 3, 20)))[what]
    assert (after.measured > 10, after.held) == (True, False)


def test_all_problems_have_one_shape_and_the_units_that_were_asked_for():
    for mixed in (False, True):
        for problem in peer_problems(2, 30, mixed):
            assert problem.P.shape == (6, 5)
            assert problem.g.shape == (5, 2)
            assert (problem.low == -1.0).all()
    sizes = [max(LinearJudge(p).scale) / min(LinearJudge(p).scale) for p in peer_problems(2, 30, True)]
    assert np.median(sizes) > 1e4
