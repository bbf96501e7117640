"""Small versions of the drives in reverse and of the long drives."""

from __future__ import annotations

import json

import pytest

from safedpa_lab.experiments.long_drives import LongDrive, LongOutcome, long_summary, run_long_drive
from safedpa_lab.experiments.reversing_drives import ReversingDrive, run_reversing_drive
from safedpa_sim.robots import core

ONCE_COLLIDED = (("box", 510), ("chair", 502))


@pytest.mark.parametrize(("load", "seed"), [*ONCE_COLLIDED, ("large_chair", 503)])
def test_no_load_collides_while_it_is_reversed_at_the_nearest_obstacle(load: str, seed: int) -> None:
    outcome = run_reversing_drive(ReversingDrive(load, seed))
    assert outcome.collisions == 0
    assert outcome.reversed_metres > 0.3
    assert outcome.least_h > -0.01


def test_a_robot_that_hides_its_load_collides(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the footprint alone leaves open; were it closed some other way, the growth would not be needed."""
    monkeypatch.setattr(core, "towed_reach", lambda load: ())
    assert sum(run_reversing_drive(ReversingDrive(*drive)).collisions for drive in ONCE_COLLIDED) > 0


def test_a_drive_is_the_same_every_time() -> None:
    drive = ReversingDrive("chair", 7, seconds=4.0)
    assert run_reversing_drive(drive) == run_reversing_drive(drive)
    long = LongDrive("large_chair", 9003, seconds=12.0)
    assert run_long_drive(long) == run_long_drive(long)


@pytest.mark.long
@pytest.mark.parametrize("seed", [9003, 7001])
def test_the_heaviest_load_gets_on_where_it_once_stood(seed: int) -> None:
    """In the dead band of a correction (9003), and short of the margin with all the room ahead (7001)."""
    outcome = run_long_drive(LongDrive("large_chair", seed, seconds=60.0))
    assert outcome.collisions == 0
    assert outcome.longest_stand < 10.0
    assert sum(outcome.statuses.values()) == 1200


@pytest.mark.long
@pytest.mark.parametrize("until_action", [0.0, 0.002, 0.006, 0.02])
def test_a_box_between_two_obstacles_gets_on_however_old_the_state_is(until_action: float) -> None:
    """It once stood for 69 s there, and crawled 0.6 m in 20 s while the policy gave up reversing to one side alone."""
    outcome = run_long_drive(LongDrive("box", 1, seconds=100.0, until_action=until_action))
    assert outcome.collisions == 0
    assert outcome.longest_stand < 10.0
    assert outcome.least_way > 0.4, "backwards the box lets it do 6 cm a second"


def test_the_summary_counts_long_standstills_and_unreported_ones() -> None:
    stand = {"from": 1.0, "seconds": 12.0, "reason": "margin: ..."}
    told = LongOutcome("box", 1, 60.0, 0, 7, (stand,), 12.0, {"passed": 1200})
    untold = LongOutcome("box", 2, 60.0, 1, 5, (), 11.0, {"passed": 1200}, 0.9)
    summary = long_summary([told, untold])
    assert json.loads(json.dumps(summary)) == summary
    assert (summary["drives"], summary["stands"], summary["untold"], summary["collisions"]) == (2, 2, 1, 1)
    assert summary["goals_a_minute"] == 6.0
    assert summary["crawls"] == 1
    assert summary["standstills"] == [{"load": "box", "seed": 1, **stand}]
