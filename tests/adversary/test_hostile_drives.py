"""Whole drives with a hostile policy: safe behind the filter, and counted where they are not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.safety.shipped import settings_named
from safedpa_sim.experiments.adversary import drives
from safedpa_sim.experiments.adversary.drives import KINDS, Driven, Drives


@pytest.mark.parametrize("kind", ["forward", "any direction", "killed"])
def test_a_drive_repeats_and_is_safe_behind_the_filter(kind):
    once, again = (KINDS[kind](kind, "box", 4, 4.0) for _ in range(2))
    assert once == again
    assert once.collisions == 0
    assert sum(once.statuses.values()) == 80
    assert {"corrected"} & set(once.statuses)


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
