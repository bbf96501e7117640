"""The figures of each attack and how many were looked at, from answers that are written down by hand."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import pytest

from safedpa_lab.experiments.adversary import scales, systems
from safedpa_lab.experiments.adversary.attack import Row
from safedpa_lab.experiments.adversary.bad_inputs import BadInputs, Treated
from safedpa_lab.experiments.adversary.bends import Bends, BentAnswer
from safedpa_lab.experiments.adversary.car_grid import CarGrid, _Answer
from safedpa_lab.experiments.adversary.drives import Driven, Drives
from safedpa_lab.experiments.adversary.late_drives import LateDrives
from safedpa_lab.experiments.adversary.linear_verdict import Judged
from safedpa_lab.experiments.adversary.mirrors import MIRRORS, Mirrors, Reflected
from safedpa_lab.experiments.adversary.programs import Programs
from safedpa_lab.experiments.delayed_drives import DelayedDrives, Lateness


def figures(rows: Sequence[Row]) -> dict[str, tuple[float, int | None]]:
    """Each figure and out of how many, by its words."""
    return {row.what: (row.measured, row.of) for row in rows}


def test_programs() -> None:
    """Of each wrong two, and one in which nothing is."""
    wrong = Judged("fallback", True, True, None, True, True, None, True, 0.5, True)
    raised = replace(wrong, status="raised ValueError", shortfall=None, missed=False)
    broken = Judged("corrected", False, False, 1.0, True, False, None, False, None, False)
    right = Judged("corrected", False, False, 0.0, False, False, 0.0, False, None, False)
    far, unheard = replace(right, excess=1.0), replace(right, excess=None)
    items = [wrong, wrong, raised, raised, broken, broken, far, far, unheard, unheard, right]
    rows = Programs().told([[(1, number, item) for number, item in enumerate(items)]]).rows
    assert figures(rows) == {
        "answers corrected": (7, None),
        "answers fallback": (2, None),
        "answers raised ValueError": (2, None),
        "raised an exception": (2, 11),
        "action out of bounds": (4, 11),
        "passed, but not the wish": (4, 11),
        "passed or corrected, condition broken": (2, 7),
        "largest break, in scales": (1.0, 7),
        "passed or corrected, predicted h < 0": (6, 7),
        "h < 0 now, and not told (or told wrongly)": (4, 11),
        "no decision computed": (2, 11),
        "corrected further than needed": (2, 3),
        "largest excess, in ranges": (1.0, 3),
        "corrected, and the reference found nothing": (2, 5),
        "not corrected, though an action keeps all": (2, 4),
        "within 1 % of the least unsafe": (0.0, 2),
        "largest shortfall, in scales": (0.5, 2),
        "h < 0 predicted, though h >= 0 attainable": (4, 4),
    }


def test_bad_inputs() -> None:
    """Nine of them; each wrong has another number."""
    told = [
        Treated("a", "raised ValueError", False, False),
        Treated("b", "corrected", True, False), Treated("c", "corrected", True, False),
        *(Treated(name, "passed", False, name == "d") for name in "def"),
        Treated("g", "refused at once", False, False), Treated("h", "refused", False, False),
        Treated("i", "fallback", False, False),
    ]  # fmt: skip
    found = BadInputs().told([*told[:4], (4, 5, 600), *told[4:]])
    assert figures(found.rows) == {
        "decisions that raised": (1, 9),
        "actions out of bounds": (2, 9),
        "an unsafe wish passed": (3, 9),
        "bad values believed": (1, 9),
        "refused when the filter was built": (2, 9),
        "two threads: answers with the other's barriers": (4, 600),
        "two threads: answers refused": (5, 600),
    }
    assert [case["fault"] for case in found.worst] == list("abcdef")


def test_bends() -> None:
    shape = "kinks"
    answers = [
        BentAnswer(0, shape, "passed", broken=0.0),
        BentAnswer(1, shape, "corrected", broken=0.25, below=True, excess=0.5),
        BentAnswer(2, shape, "corrected", broken=0.0, excess=0.05),
        BentAnswer(3, shape, "corrected", broken=0.0, excess=0.0),
        BentAnswer(4, shape, "relaxed", missed=True, shortfall=0.5, needless=True),
        BentAnswer(5, shape, "relaxed", missed=True, shortfall=0.001),
        BentAnswer(6, shape, "violated", shortfall=0.2),
        BentAnswer(7, shape, "fallback"),
        BentAnswer(8, shape, "raised ValueError"),
    ]
    found = figures(Bends().told([answers[:5], answers[5:]]).rows)
    assert {what: told for what, told in found.items() if what.startswith(f"{shape}: ")} == {
        "kinks: raised, or no decision": (2, 9),
        "kinks: largest break of a condition, in scales": (0.25, 4),
        "kinks: passed or corrected, predicted h < 0": (1, 4),
        "kinks: not corrected, though the grid keeps all": (2, 5),
        "kinks: corrected 0.1 of a range beyond the grid": (pytest.approx(100.0 / 3.0), 3),
        "kinks: h < 0 predicted, grid keeps h >= 0": (1, 5),
        "kinks: 1 % of scale below the grid's least unsafe": (2, 5),
    }
    assert [found[f"answers {status}"] for status in ("corrected", "passed", "relaxed")] == [
        (3, None),
        (1, None),
        (2, None),
    ]


def test_the_car_against_the_grid() -> None:
    answers = [
        _Answer(0, "passed", 0.0, below=False, missed=False, excess=None, shortfall=None, untold=True),
        _Answer(1, "corrected", 0.5, below=True, missed=False, excess=0.3, shortfall=None, untold=False),
        _Answer(2, "corrected", 0.0, below=True, missed=False, excess=0.0, shortfall=None, untold=False),
        _Answer(3, "relaxed", None, below=False, missed=True, excess=None, shortfall=0.25, untold=True),
        _Answer(4, "fallback", None, below=False, missed=False, excess=None, shortfall=0.001, untold=True),
        _Answer(5, "violated", None, below=False, missed=False, excess=None, shortfall=0.125, untold=False),
    ]
    kind = CarGrid().pieces(1, small=True)[0][0]
    found = figures(CarGrid().told([(kind, answers[:2]), (kind, answers[2:])]).rows)
    assert {what.removeprefix(f"{kind}: "): told for what, told in found.items() if what.startswith(f"{kind}: ")} == {
        "answers corrected": (2, None),
        "answers fallback": (1, None),
        "answers passed": (1, None),
        "answers relaxed": (1, None),
        "answers violated": (1, None),
        "largest break of a condition, in scales": (0.5, 3),
        "passed or corrected, predicted h < 0": (2, 3),
        "h < 0 now, and not told (or told wrongly)": (3, 6),
        "relaxed, though the grid keeps all": (1, 2),
        "corrected 0.1 of a range beyond the grid": (50.0, 2),
        "largest excess, in ranges": (0.3, 2),
        "relaxed or violated: 1 % of scale below the grid": (2, 3),
        "largest shortfall, in scales": (0.25, 3),
    }


def test_mirrors() -> None:
    one, other = list(MIRRORS)[:2]
    both = ("passed", "passed")
    answers = [
        [Reflected(one, 0, both, 0.25, same=False), Reflected(one, 1, both, 0.5, same=False)],
        [Reflected(one, 2, both, 0.0, same=True), Reflected(other, 0, both, 1e-9, same=True)],
    ]
    found = figures(Mirrors().told(answers).rows)
    assert (found[f"{one}: other answers"], found[f"{one}: furthest apart"]) == ((2, 3), (0.5, 3))
    assert (found[f"{other}: other answers"], found[f"{other}: furthest apart"]) == ((0, 1), (1e-9, 1))
    assert (found["its own answer wished: other answers"], len(found)) == ((0, 0), 2 * len(MIRRORS) + 4)


def test_drives_with_hostile_policies() -> None:
    drives = [
        Driven("car", "box", 1, 0, 0.5, {"passed": 3}),
        Driven("car", "box", 2, 3, -0.25, {"passed": 4, "corrected": 1}),
        Driven("car", "box", 3, 1, 0.125, {}),
        Driven("point", "none", 4, 0, 0.75, {"relaxed": 1}),
        Driven("point", "none", 5, 0, float("inf"), {}, missing="no such robot"),
    ]
    found = Drives().told(drives)
    assert figures(found.rows) == {
        "car: drives with a collision (corrected 12.5 %, passed 87.5 %)": (2, 3),
        "car: least h told": (-0.25, 3),
        "point: drives with a collision (relaxed 100.0 %)": (0, 1),
        "point: least h told": (0.75, 1),
    }
    assert [case.get("seed", case["fault"]) for case in found.worst] == [2, 3, "no such robot"]


@pytest.mark.parametrize(("corrected", "beyond"), [(30, 0), (5, 13)])
def test_drives_whose_commands_come_late(corrected: int, beyond: int) -> None:
    statuses = Counter(passed=2, corrected=corrected, relaxed=9, violated=6, fallback=3)
    lateness = Lateness(0.15, "both", "clock")
    driven = DelayedDrives(lateness, drives=7, collided=2, collisions=5, goals=11, least_h=-0.5, statuses=statuses)
    collisions, worse, goals, least = LateDrives().told([driven]).rows
    assert collisions.what.startswith("150 ms, told by the clock: drives with a collision (corrected ")
    assert (collisions.measured, collisions.of) == (2, 7)
    assert (worse.measured, worse.of) == (beyond, 20 + corrected)
    assert (goals.measured, goals.of, least.measured, least.of) == (11, 7, -0.5, 7)


def test_a_system_in_closed_loop() -> None:
    tally = systems.Tally(
        Counter(passed=3, relaxed=1), least_h=-0.5, crashed=2, episodes=6, broken=0.25, kept=9, below=4, missed=3,
        needless=1, unkept=5, excess=[0.0, 0.2, 0.05, 0.3],
    )  # fmt: skip
    system = systems.SYSTEMS[0]()
    found = figures(systems._rows(system, tally))
    assert {what.removeprefix(f"{system.name}: "): told for what, told in found.items()} == {
        "least h in truth (passed 75.0 %, relaxed 25.0 %)": (-0.5, 6),
        "episodes with h < 0": (2, 6),
        "largest break, in scales": (0.25, 9),
        "passed or corrected, predicted h < 0": (4, 9),
        "relaxed, though the grid keeps all": (3, 5),
        "h < 0 predicted, though the grid keeps h >= 0": (1, 5),
        "corrected 0.1 of a range beyond the grid": (50.0, 4),
    }


def test_other_units() -> None:
    """An action of -1 to 1 has a range of 2."""
    same = scales.Drive(("passed", "corrected"), (0.0, 1.0), 0.9, 0.0)
    other = scales.Drive(("passed", "relaxed"), (0.5, 1.0), 1.5, 0.0)
    assert figures(scales._rows("h", [same, other, same], same)) == {
        "h: furthest point": (1.5, 3),
        "h: drives with other statuses": (1, 3),
        "h: largest change of an action, in ranges": (0.25, 3),
    }
