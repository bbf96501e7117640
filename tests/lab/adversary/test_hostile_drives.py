"""Whole drives with a hostile policy: safe behind the filter, and counted where they are not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments.adversary import drives, standing
from safedpa_lab.experiments.adversary.drives import KINDS, Driven, Drives
from safedpa_lab.experiments.adversary.late_drives import LateDrives
from safedpa_lab.experiments.adversary.standing import Standing
from safedpa_lab.experiments.long_drives import LongOutcome


@pytest.mark.parametrize("kind", ["forward", "any direction", "killed", "reversing"])
def test_a_drive_repeats_and_is_safe_behind_the_filter(kind):
    once, again = (KINDS[kind](kind, "box", 4, 4.0) for _ in range(2))
    assert once == again
    assert once.collisions == 0
    assert sum(once.statuses.values()) == 80
    assert {"corrected"} & set(once.statuses)


def test_standstills_are_counted_and_unreported_ones_too(monkeypatch):
    def stood(drive):
        told = ({"from": 1.0, "seconds": 12.0, "reason": "boxed in"},) if drive.seed % 2 else ()
        return LongOutcome(drive.load, drive.seed, drive.seconds, 0, 3, told, 12.0, {"passed": 1}, 0.9)

    monkeypatch.setattr(standing, "run_long_drive", stood)
    attack = Standing()
    rows = {row.what: row for row in attack.told([attack.work(each) for each in attack.pieces(3, False)]).rows}
    assert rows["drives with a stand of 10 s and more"].measured == 100
    assert rows["of these, not told"].measured == 52  # the even seeds
    assert rows["point robot: drives with a stand of 10 s and more"].measured == 25
    assert rows["goals a minute"].measured == 1.5
    assert not any(rows[what].held for what in list(rows)[:4])
    assert rows["collisions"].held


def test_a_short_drive_of_every_load_gets_on():
    attack = Standing()
    answers = [attack.work(each) for each in attack.pieces(1, True)]
    assert [answer.load for answer in answers] == ["none", "box", "chair", "large_chair", "point"]
    assert sum(answers[-1].statuses.values()) == 200, "the point robot decides 50 times a second"
    assert attack.told(answers).rows[0].held


def test_late_drives_are_grouped_by_who_knows_the_delay():
    attack = LateDrives()
    pieces = attack.pieces(2, True)
    found = [attack.work(piece) for piece in pieces]
    rows = {row.what.split(" (")[0]: row for row in attack.told(found).rows}
    assert rows["200 ms, known to the model: drives with a collision"].held
    assert rows["150 ms, known to nobody: relaxed and worse beyond corrected"].held is None
    found[0].collided, found[0].statuses["relaxed"] = 1, 1000
    rows = {row.what.split(" (")[0]: row for row in attack.told(found).rows}
    assert rows["200 ms, known to the model: drives with a collision"].held is False
    assert rows["200 ms, known to the model: relaxed and worse beyond corrected"].held is False


def test_without_the_filter_the_same_policies_hit_something(monkeypatch):
    off = replace(settings_named("car"), enabled=False)
    monkeypatch.setattr(drives, "settings_named", lambda name: off)
    attack = Drives()
    answers = [KINDS[kind](kind, "none", seed, 8.0) for kind in ("forward", "killed") for seed in (4, 5)]
    rows = {row.what.split(" (")[0]: row for row in attack.told(answers).rows}
    assert rows["forward: drives with a collision"].measured > 0
    assert rows["forward: drives with a collision"].held is False
    assert attack.told(answers).worst[0]["fault"] == "collision"


def test_a_point_robot_is_driven_at_its_hazards():
    pytest.importorskip("mujoco")
    driven = KINDS["point"]("point", "none", 3, 4.0)
    assert driven.collisions == 0
    assert driven.statuses["corrected"] > 0


def test_a_pendulum_is_pushed_out_of_its_corridor():
    driven = KINDS["pendulum"]("pendulum", "none", 3, 8.0)
    assert driven.collisions == 0
    assert driven.statuses["corrected"] > 0


def test_a_robot_that_cannot_be_simulated_here_is_named():
    missing = Driven("point", "none", 1, 0, 0.0, {}, "point robot: No module named 'mujoco'")
    result = Drives().told([missing])
    assert [row.of for row in result.rows] == [0, 0]
    assert result.worst[0]["fault"] == "point robot: No module named 'mujoco'"
