"""The attacks count what is wrong with a filter, whatever it is: planted faults make their counts rise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.lab.adversary.problems import measured

from safedpa.safety import SafetyFilter, Status, Verdict
from safedpa_lab.experiments.adversary.attack import Result, Row, WholeAttack
from safedpa_lab.experiments.adversary.bad_inputs import BadInputs
from safedpa_lab.experiments.adversary.car_grid import CarGrid, odd_question
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

        def decide(self, state, wish, *others, **known):
            return change(original(self, state, wish, *others, **known), wish)

        patch.setattr(SafetyFilter, "decide", decide)

    return planted


@pytest.fixture
def plant(monkeypatch):
    """Changes every verdict on its way out: ``plant(lambda verdict, wish: ...)``."""
    return planted_by(monkeypatch)


@pytest.fixture(scope="module")
def all_passed() -> Result:
    """What the programs count behind a filter that passes everything."""
    attack = Programs()
    with pytest.MonkeyPatch.context() as patch:
        planted_by(patch)(passes_everything)
        return attack.told([attack.work(piece) for piece in attack.pieces(1, small=True)])


def frozen(action):
    taken = np.array(action, dtype=np.float64)
    taken.setflags(write=False)
    return taken


def passes_everything(verdict, wish):
    """What a filter that is switched off and lies about it would say."""
    return replace(verdict, action=frozen(np.asarray(wish, dtype=np.float64)), status=Status.passed)


def a_little_less(verdict, wish):
    """A correction that goes only 99.9 % of the way, as a tolerance would allow it."""
    if verdict.status is not Status.corrected:
        return verdict
    moved = verdict.action + 1e-3 * (np.asarray(wish) - verdict.action)
    return replace(verdict, action=frozen(moved))


@pytest.mark.long
def test_the_programs_notice_a_filter_that_goes_not_all_the_way(clean, plant):
    before = clean["passed or corrected, condition broken"].measured
    plant(a_little_less)
    after = measured(Programs())["passed or corrected, condition broken"].measured
    assert after > before + 50


def test_the_programs_notice_actions_that_are_swapped_for_the_wish(all_passed):
    found = {row.what: row for row in all_passed.rows}
    assert found["passed or corrected, condition broken"].measured > 200
    assert found["passed or corrected, predicted h < 0"].measured > 100
    assert found["h < 0 now, and not told (or told wrongly)"].measured > 25
    assert found["action out of bounds"].measured > 100


@pytest.mark.long
def test_the_programs_notice_corrections_that_go_too_far(clean, plant):
    def middle(verdict, wish):
        if verdict.status is not Status.passed:
            return verdict
        return replace(verdict, status=Status.corrected, action=frozen(0.999 * verdict.action))

    before = clean["corrected further than needed"].measured
    plant(middle)
    assert measured(Programs())["corrected further than needed"].measured > before + 5


def test_the_programs_notice_an_infeasible_answer_that_is_not_the_least_unsafe(plant):
    def other_end(verdict, wish):
        if verdict.status in (Status.passed, Status.corrected):
            return verdict
        return replace(verdict, status=Status.relaxed, action=frozen(-verdict.action + 2.0 * np.asarray(wish)))

    plant(other_end)
    found = measured(Programs())
    assert found["within 1 % of the least unsafe"].measured < 60.0
    assert found["h < 0 predicted, though h >= 0 attainable"].measured > 5
    assert found["not corrected, though an action keeps all"].of is not None


def test_the_programs_notice_an_exception_and_a_refusal(plant, monkeypatch):
    def raises(*_args, **_known):
        raise RuntimeError("planted")

    monkeypatch.setattr(SafetyFilter, "decide", raises)
    found = measured(Programs())
    assert found["raised an exception"].measured == found["raised an exception"].of == 330


def test_the_worst_programs_are_reported_with_their_numbers(all_passed):
    worst = [case for case in all_passed.worst if case["fault"] == "condition broken"]
    assert worst[0]["size"] >= worst[-1]["size"] > 0.0
    assert worst[0]["count"] > 200
    assert 0 <= worst[0]["number"] < 330


def test_the_drive_at_scale_one_stops_before_the_wall_and_a_deaf_filter_does_not(plant):
    assert drive(Units()).furthest < 1.0
    plant(passes_everything)
    assert drive(Units()).furthest > 1.0


@pytest.mark.long
def test_other_units_of_a_filter_with_an_absolute_tolerance_are_noticed(plant):
    """Planted: the wish is believed whenever h is small, as an absolute tolerance would have it."""

    def absolute(verdict, wish):
        if verdict.status is Status.corrected and abs(verdict.h_now) < 1e-4:
            return passes_everything(verdict, wish)
        return verdict

    plant(absolute)
    found = measured(Scales())
    assert found["h: furthest point"].measured > 1.0
    assert found["h: drives with other statuses"].measured > 0
    assert found["furthest point at scale 1"].held


def test_the_car_grid_notices_what_it_is_for(plant):
    def stops(verdict, wish):
        if verdict.status is not Status.corrected:
            return replace(verdict, status=Status.relaxed)
        return replace(verdict, action=frozen([-0.6, 0.34]))

    plant(stops)
    found = measured(CarGrid())
    assert found["car: relaxed, though the grid keeps all"].measured > 50
    assert found["car: corrected 0.1 of a range beyond the grid"].measured > 20.0
    assert found["car: corrected 0.1 of a range beyond the grid"].held is False


def test_the_car_grid_notices_broken_conditions(plant):
    plant(passes_everything)
    found = measured(CarGrid())
    assert found["car: largest break of a condition, in scales"].measured > 0.01
    assert found["car: passed or corrected, predicted h < 0"].measured > 0


def test_odd_scenes_have_their_stated_oddity():
    sizes = [len(odd_question(1, number).obstacles) for number in range(5)]
    assert sizes[3] == 60
    assert sizes[1] % 3 == 0
    assert odd_question(1, 2).obstacles[0, 2] == 1000.0
    body = odd_question(1, 0)
    assert np.array_equal(body.obstacles[-1, :2], body.state[:2])
    assert (odd_question(1, 4).obstacles[:, 2] == 0.0).all()


def test_the_systems_crash_behind_a_filter_that_passes_everything(plant):
    def deaf(verdict, wish):
        action = np.where(np.isfinite(wish), wish, 0.0)
        return replace(verdict, action=frozen(action), status=Status.passed)

    plant(deaf)
    found = measured(Systems())
    crashed = [row for what, row in found.items() if what.endswith("episodes with h < 0")]
    assert len(crashed) == len(SYSTEMS)
    assert sum(row.measured > 0 for row in crashed) >= 8
    assert not any(row.held for what, row in found.items() if what.endswith("largest break, in scales"))


@pytest.mark.long
def test_the_systems_notice_what_the_grid_knows_better(plant):
    def gives_up(verdict, wish):
        return replace(verdict, status=Status.relaxed) if verdict.status is Status.corrected else verdict

    plant(gives_up)
    missed = [row for what, row in measured(Systems()).items() if what.endswith("though the grid keeps all")]
    assert sum(row.measured > 10 for row in missed) >= 8


def test_bad_inputs_are_counted(plant):
    def believes(verdict, wish):
        return replace(verdict, status=Status.passed)

    plant(believes)
    found = measured(BadInputs())
    count = found["an unsafe wish passed"].of
    assert count is not None
    assert count > 120
    assert found["an unsafe wish passed"].measured > 100
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
    from safedpa_lab.experiments.adversary.bad_inputs import two_threads

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


def test_an_experiment_plugs_in_as_a_whole():
    attack = WholeAttack("own", "own", lambda seed, small: Result([Row("seed", seed, most=3)], [{"small": small}]))
    answers = [attack.work(piece) for piece in attack.pieces(5, small=True)]
    result = attack.told(answers)
    assert [(row.measured, row.held) for row in result.rows] == [(5, False)]
    assert list(result.worst) == [{"small": True}]
