"""The figures of each attack, counted from answers whose faults are known, and from whole hostile drives."""

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from tests.lab.adversary.problems import figures

from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.adversary import campaign as report
from safedpa_lab.experiments.adversary import drives, systems
from safedpa_lab.experiments.adversary import drives as standing
from safedpa_lab.experiments.adversary.attack import Judged, Result, Row, WholeAttack
from safedpa_lab.experiments.adversary.bad_inputs import BadInputs, Treated
from safedpa_lab.experiments.adversary.bends import Bends
from safedpa_lab.experiments.adversary.campaign import adversary
from safedpa_lab.experiments.adversary.car_grid import CarGrid
from safedpa_lab.experiments.adversary.drives import KINDS, Driven, Drives, LateDrives, Standing
from safedpa_lab.experiments.adversary.linear.problem import shape_of
from safedpa_lab.experiments.adversary.mirrors import MIRRORS, Mirrors, Reflected
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_lab.experiments.adversary.scales import Drive, Scales, Units, drive
from safedpa_lab.experiments.common.drives import Outcome
from safedpa_lab.experiments.driving.delayed_drives import DelayedDrives, Lateness
from safedpa_lab.experiments.driving.long_drives import LongOutcome

RIGHT = Judged(status="corrected", broken=0.0, excess=0.0)
BENT = replace(RIGHT, number=0, shape="kinks")


def test_linear_problems_are_counted_by_fault() -> None:
    wrong = Judged(
        status="fallback", out_of_bounds=True, altered=True, below=True, untold=True, missed=True, shortfall=0.5,
        needless=True,
    )  # fmt: skip
    raised = replace(wrong, status="raised ValueError", shortfall=None, missed=False)
    broken = Judged(status="corrected", broken=1.0, below=True)
    far, unheard = replace(RIGHT, excess=1.0), replace(RIGHT, excess=None)
    items = [wrong, wrong, raised, raised, broken, broken, far, far, unheard, unheard, RIGHT]
    found = Programs().reported([(1, [replace(item, number=number) for number, item in enumerate(items)])])
    assert figures(found.rows) == {
        "answers corrected": (7, None), "answers fallback": (2, None), "answers raised ValueError": (2, None),
        "raised an exception": (2, 11), "action out of bounds": (4, 11), "passed, but not the nominal action": (4, 11),
        "passed or corrected, condition broken": (2, 7), "largest break, in scales": (1.0, 7),
        "passed or corrected, predicted h < 0": (6, 7), "h < 0 now, and not reported (or reported wrongly)": (4, 11),
        "no decision computed": (2, 11), "corrected further than needed": (2, 3),
        "largest excess, in ranges": (1.0, 3), "corrected, and the reference found nothing": (2, 5),
        "not corrected, though an action keeps all": (2, 4), "within 1 % of the least-violation": (0.0, 2),
        "largest shortfall, in scales": (0.5, 2), "h < 0 predicted, though h >= 0 attainable": (4, 4),
    }  # fmt: skip
    assert {case["fault"]: case["count"] for case in found.worst} == {
        "condition broken": 2, "predicted h < 0": 6, "h < 0 now not reported": 4, "no decision": 4, "too far": 2,
        "missed": 2, "not the least-violation": 2, "h < 0 though h >= 0 attainable": 4,
    }  # fmt: skip


def test_bad_inputs_are_counted_by_treatment() -> None:
    treated = [
        Treated("a", "raised ValueError", False, False),
        Treated("b", "corrected", True, False), Treated("c", "corrected", True, False),
        *(Treated(name, "passed", False, name == "d") for name in "def"),
        Treated("g", "refused at once", False, False), Treated("h", "refused", False, False),
        Treated("i", "fallback", False, False),
    ]  # fmt: skip
    found = BadInputs().reported([*treated[:4], (4, 5, 600), *treated[4:]])
    assert figures(found.rows) == {
        "decisions that raised": (1, 9), "actions out of bounds": (2, 9), "an unsafe nominal action passed": (3, 9),
        "bad values believed": (1, 9), "refused when the filter was built": (2, 9),
        "two threads: answers with the other's barriers": (4, 600), "two threads: answers refused": (5, 600),
    }  # fmt: skip
    assert [case["fault"] for case in found.worst] == list("abcdef")


def test_answers_to_bent_problems_are_counted_by_shape() -> None:
    rest = replace(BENT, broken=None, excess=None)
    answers = [
        replace(BENT, status="passed", excess=None),
        replace(BENT, broken=0.25, below=True, excess=0.5), replace(BENT, below=True, excess=0.3),
        replace(BENT, excess=0.05), BENT,
        *[replace(rest, status="relaxed", missed=True, shortfall=0.5, needless=True)] * 3,
        replace(rest, status="relaxed", missed=True, shortfall=0.001), replace(rest, status="violated", shortfall=0.2),
        replace(rest, status="fallback"), replace(rest, status="raised ValueError"),
    ]  # fmt: skip
    rows = Bends().reported([answers[:5], answers[5:]]).rows
    assert figures(rows, "kinks: ") == {
        "raised, or no decision": (2, 12), "largest break of a condition, in scales": (0.25, 5),
        "passed or corrected, predicted h < 0": (2, 5), "not corrected, though the grid keeps all": (4, 7),
        "corrected 0.1 of a range beyond the grid": (50.0, 4), "h < 0 predicted, grid keeps h >= 0": (3, 7),
        "1 % of scale below the grid's least-violation": (4, 7),
    }  # fmt: skip
    assert {row.what: row.measured for row in rows if row.what.startswith("answers ")} == {
        "answers corrected": 4, "answers fallback": 1, "answers passed": 1, "answers raised ValueError": 1,
        "answers relaxed": 4, "answers violated": 1,
    }  # fmt: skip


@pytest.fixture(scope="module")
def car_answer() -> Any:
    """An answer of the car, as ``CarGrid`` makes it; tests replace all its values."""
    _, (answer,) = CarGrid().work(("car", 1, 0, 1))
    return replace(answer, status="corrected", broken=0.0, below=False, missed=False, excess=0.0, shortfall=None,
                   untold=False)  # fmt: skip


def test_answers_of_the_car_are_counted_against_the_grid(car_answer: Any) -> None:
    relaxed = replace(car_answer, status="relaxed", broken=None, missed=True, excess=None, shortfall=0.25, untold=True)
    answers = [
        replace(car_answer, status="passed", excess=None, untold=True),
        replace(car_answer, broken=0.5, below=True, excess=0.3), replace(car_answer, below=True, excess=0.2),
        car_answer, relaxed, relaxed, replace(relaxed, status="fallback", missed=False, shortfall=0.001),
        replace(relaxed, status="violated", missed=False, shortfall=0.125, untold=False),
    ]  # fmt: skip
    found = CarGrid().reported([("car", answers[:2]), ("car", answers[2:]), ("odd scenes", [car_answer])])
    assert figures(found.rows, "car: ") == {
        "answers corrected": (3, None), "answers fallback": (1, None), "answers passed": (1, None),
        "answers relaxed": (2, None), "answers violated": (1, None),
        "largest break of a condition, in scales": (0.5, 4), "passed or corrected, predicted h < 0": (2, 4),
        "h < 0 now, and not reported (or reported wrongly)": (4, 8), "relaxed, though the grid keeps all": (2, 3),
        "corrected 0.1 of a range beyond the grid": (pytest.approx(200.0 / 3.0), 3),
        "largest excess, in ranges": (0.3, 3), "relaxed or violated: 1 % of scale below the grid": (3, 4),
        "largest shortfall, in scales": (0.25, 4),
    }  # fmt: skip
    assert figures(found.rows, "odd scenes: ")["answers corrected"] == (1, None)


@pytest.mark.parametrize("attack", [Programs(), Bends(), CarGrid()], ids=lambda attack: attack.name)
@pytest.mark.parametrize(
    ("sizes", "numbers", "count"),
    [([0.0, 0.5, 0.25, 1e-12, 0.75, 0.125], [4, 1, 2], 4), ([0.5], [0], 1), ([0.25, 0.0, 0.5], [2, 0], 2)],
)
def test_the_three_largest_breaks_are_reported_with_their_count(attack, sizes, numbers, count, car_answer) -> None:
    made = {
        "programs": lambda number, size: replace(RIGHT, number=number, shape=shape_of(number), broken=size),
        "bends": lambda number, size: replace(BENT, number=number, broken=size),
        "car": lambda number, size: replace(car_answer, number=number, broken=size),
    }[attack.name]
    items = [made(number, size) for number, size in enumerate(sizes)]
    kind = {"programs": 7, "car": "car"}.get(attack.name)
    worst = attack.reported([items if kind is None else (kind, items)]).worst
    assert [case["number"] for case in worst] == numbers
    assert [case["size"] for case in worst] == [sizes[number] for number in numbers]
    assert {(case["fault"], case["count"]) for case in worst} == {("condition broken", count)}
    if attack.name == "programs":  # seed, number and shape are what a user needs to draw the problem again
        assert [(case["seed"], case["shape"]) for case in worst] == [(7, shape_of(number)) for number in numbers]


def test_reflections_are_counted_and_the_three_furthest_of_a_mirror_are_reported() -> None:
    one, other = list(MIRRORS)[:2]
    items = [Reflected(one, n, ("passed", "passed"), 0.1 * n, n == 0) for n in range(5)]
    items += [Reflected(other, 9, ("passed", "relaxed"), 0.5, False), Reflected(other, 8, ("passed",) * 2, 9.0, True)]
    found = Mirrors().reported([items[:2], items[2:]])
    counts = figures(found.rows)
    assert (counts[f"{one}: other answers"], counts[f"{one}: furthest apart"]) == ((4, 5), (0.4, 5))
    assert (counts[f"{other}: other answers"], counts[f"{other}: furthest apart"]) == ((1, 2), (9.0, 2))
    assert (counts["its own answer requested: other answers"], len(counts)) == ((0, 0), 2 * len(MIRRORS) + 4)
    assert [(case["fault"], case["number"], case["count"]) for case in found.worst] == [
        (one, 4, 4), (one, 3, 4), (one, 2, 4), (other, 9, 1),
    ]  # fmt: skip


def test_hostile_drives_are_counted_by_kind() -> None:
    found = Drives().reported([
        Driven("car", "box", 1, Outcome(0, 0, 0.5, {"passed": 3})),
        Driven("car", "box", 2, Outcome(3, 0, -0.25, {"passed": 4, "corrected": 1})),
        Driven("car", "box", 3, Outcome(1, 0, 0.125, {})),
        Driven("point", "none", 4, Outcome(0, 0, 0.75, {"relaxed": 1})),
        Driven("point", "none", 5, None, missing="no such robot"),
    ])  # fmt: skip
    assert figures(found.rows) == {
        "car: drives with a collision (corrected 12.5 %, passed 87.5 %)": (2, 3), "car: least reported h": (-0.25, 3),
        "point: drives with a collision (relaxed 100.0 %)": (0, 1), "point: least reported h": (0.75, 1),
    }  # fmt: skip
    assert [(case.get("seed", case["fault"]), case.get("count")) for case in found.worst] == [
        (2, 3), (3, 1), ("no such robot", None)
    ]  # fmt: skip


@pytest.mark.parametrize(("corrected", "beyond"), [(30, 0), (5, 13)])
def test_drives_with_late_commands_are_reported_with_their_delay(corrected: int, beyond: int) -> None:
    statuses = Counter(passed=2, corrected=corrected, relaxed=9, violated=6, fallback=3)
    driven = DelayedDrives(Lateness(0.15, "both", "clock"), 7, 2, 5, 11, -0.5, statuses, 4, 1)
    collisions, after, worse, goals, least = LateDrives().reported([(driven, 1.0)]).rows
    assert collisions.what.startswith("150 ms, reported by the clock: drives with a collision (corrected ")
    assert (collisions.measured, collisions.of) == (2, 7)
    assert (after.measured, after.of, after.held) == (1, 7, False)
    assert (worse.measured, worse.of) == (beyond, 20 + corrected)
    assert (goals.measured, goals.of, least.measured, least.of) == (11, 7, -0.5, 7)


def test_episodes_of_a_system_are_added_up() -> None:
    """Counts add, the least h is the smallest, the break the largest."""
    rest = replace(RIGHT, status="relaxed", broken=None, excess=None)
    bad = [*[replace(rest, missed=True, needless=True)] * 3, *[rest] * 6]
    kept = [replace(RIGHT, broken=0.25, below=True, excess=excess) for excess in (0.0, 0.2, 0.05, 0.3)]
    one = systems.Tally(Counter(passed=2), 0.5, 1, 2, [*kept, *bad[:4]])
    other = systems.Tally(
        Counter(passed=1, relaxed=1), -0.5, 2, 3, [*[replace(RIGHT, status="passed", excess=None)] * 4, *bad[4:]]
    )
    name = systems.SYSTEMS[0]().name
    nothing = [(index, systems.Tally(Counter(passed=1))) for index in range(1, len(systems.SYSTEMS))]
    assert figures(systems.Systems().reported([(0, one), *nothing, (0, other)]).rows, f"{name}: ") == {
        "least h in truth (passed 75.0 %, relaxed 25.0 %)": (-0.5, 5), "episodes with h < 0": (3, 5),
        "largest break, in scales": (0.25, 8), "passed or corrected, predicted h < 0": (4, 8),
        "relaxed, though the grid keeps all": (3, 9), "h < 0 predicted, though the grid keeps h >= 0": (3, 9),
        "corrected 0.1 of a range beyond the grid": (50.0, 4),
    }  # fmt: skip


def test_drives_in_other_units_are_compared_with_the_drive_at_scale_one() -> None:
    """An action has a range of 2: half the largest difference is reported."""
    same = drive(Units())
    moved = replace(same, actions=(same.actions[0] - 0.5, *same.actions[1:]), furthest=1.5)
    other = replace(same, statuses=("relaxed", *same.statuses[1:]))
    found = Scales().reported([(Units(), moved), (Units(), same), (Units(), other), (Units(), other)])
    assert figures(found.rows, "h: ") == {
        "furthest point": (1.5, 4), "drives with other statuses": (2, 4),
        "largest change of an action, in ranges": (0.25, 4),
    }  # fmt: skip
    assert [case["furthest"] for case in found.worst] == [1.5, other.furthest, other.furthest]
    assert isinstance(same, Drive)


def test_a_campaign_reports_progress_keeps_each_part_and_counts_what_held() -> None:
    """A figure without a limit, or of nothing, neither held nor failed."""
    rows = [
        Row("a", 1.0, 9, most=2.0), Row("b", 3.0, 9, most=2.0), Row("c", 3.0), Row("d", 5.0, 9, least=4.0),
        Row("e", 1.0, 0, most=2.0), Row("f", 1.0, 9, least=0.5, most=2.0), Row("g", 9.0, 9, most=2.0),
    ]  # fmt: skip
    attacks = [WholeAttack(name, "", lambda *_: Result(rows)) for name in ("one", "two", "three")]
    progress: list[tuple[int, int]] = []
    parts: list[int] = []
    found = adversary(
        attacks,
        1,
        report_progress=lambda *one: progress.append(one),
        keep=lambda result: parts.append(len(result["attacks"])),
    )
    assert (progress, parts) == ([(1, 3), (2, 3), (3, 3)], [1, 2, 3])
    assert [(one["name"], one["held"], one["failed"], len(one["rows"])) for one in found["attacks"]] == [
        (name, 3, 2, 7) for name in ("one", "two", "three")
    ]


@pytest.mark.parametrize("other", ["", "experiment", "seed", "small", "code"])
def test_parts_of_a_different_campaign_are_left_out(other: str, tmp_path: Path) -> None:
    same: dict[str, Any] = {"experiment": "adversary", "seed": 1, "small": True, "code": "c"}
    before = same | ({other: "another"} if other else {})
    (tmp_path / "adversary.json").write_text(json.dumps(before | {"attacks": [{"name": "a"}, {"name": "b", "old": 1}]}))
    result = same | {"attacks": [{"name": "b", "old": 0}]}
    found = report.with_parts_before(result, tmp_path, ["c", "b", "a"])
    assert found["attacks"] == ([{"name": "b", "old": 0}] + ([] if other else [{"name": "a"}]))


@pytest.mark.long
@pytest.mark.parametrize("kind", ["forward", "any direction", "killed", "reversing"])
def test_a_drive_repeats_and_is_safe_behind_the_filter(kind):
    once, again = (KINDS[kind]("box", 4, 4.0) for _ in range(2))
    assert (once, once.collisions, sum(once.statuses.values())) == (again, 0, 80)
    assert {"corrected"} & set(once.statuses)


def test_standstills_are_counted_and_unreported_ones_too(monkeypatch):
    def stood(drive):
        reported = ({"from": 1.0, "seconds": 12.0, "reason": "boxed in"},) if drive.seed % 2 else ()
        return LongOutcome(drive.load, drive.seed, drive.seconds, 0, 3, reported, 12.0, {"passed": 1}, 0.9)

    monkeypatch.setattr(standing, "run_long_drive", stood)
    attack = Standing()
    rows = {row.what: row for row in attack.reported([attack.work(each) for each in attack.pieces(3, False)]).rows}
    assert rows["drives with a stand of 10 s and more"].measured == 100
    assert rows["of these, not reported"].measured == 52  # the even seeds
    assert rows["point robot: drives with a stand of 10 s and more"].measured == 25
    assert rows["goals a minute"].measured == 1.5
    assert not any(rows[what].held for what in list(rows)[:4])
    assert rows["collisions"].held


def test_a_short_drive_of_every_load_gets_on():
    attack = Standing()
    answers = [attack.work(each) for each in attack.pieces(1, True)]
    assert [answer.load for answer in answers] == ["none", "box", "chair", "large_chair", "point"]
    assert sum(answers[-1].statuses.values()) == 200, "the point robot decides 50 times a second"
    assert attack.reported(answers).rows[0].held


def test_late_drives_are_grouped_by_who_knows_the_delay():
    attack = LateDrives()
    pieces = attack.pieces(2, True)
    found = [attack.work(piece) for piece in pieces]
    rows = {row.what.split(" (")[0]: row for row in attack.reported(found).rows}
    assert rows["200 ms, known to the model: drives with a collision"].held
    assert rows["150 ms, known to no one: relaxed and worse beyond corrected"].held is None
    found[0][0].collided, found[0][0].statuses["relaxed"] = 1, 1000
    rows = {row.what.split(" (")[0]: row for row in attack.reported(found).rows}
    assert rows["200 ms, known to the model: drives with a collision"].held is False
    assert rows["200 ms, known to the model: relaxed and worse beyond corrected"].held is False


def test_without_the_filter_the_same_policies_hit_something(monkeypatch):
    off = replace(settings_named("car"), enabled=False)
    monkeypatch.setattr(drives, "settings_named", lambda name: off)
    attack = Drives()
    answers = [attack.work((kind, "none", seed, 8.0)) for kind in ("forward", "killed") for seed in (4, 5)]
    rows = {row.what.split(" (")[0]: row for row in attack.reported(answers).rows}
    assert rows["forward: drives with a collision"].measured > 0
    assert rows["forward: drives with a collision"].held is False
    assert attack.reported(answers).worst[0]["fault"] == "collision"


@pytest.mark.parametrize(("kind", "seconds"), [("point", 4.0), ("pendulum", 8.0)])
def test_a_point_robot_and_a_pendulum_are_driven_at_what_they_must_not_touch(kind, seconds):
    if kind == "point":
        pytest.importorskip("mujoco")
    driven = KINDS[kind]("none", 3, seconds)
    assert (driven.collisions, driven.statuses["corrected"] > 0) == (0, True)
