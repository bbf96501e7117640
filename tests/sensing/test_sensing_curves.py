"""The curves of a laser among people: one thing differs at a time, and page and picture show every value."""

from __future__ import annotations

from dataclasses import replace
from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import sensing
from safedpa_lab.experiments.sensing import Drive, run_drive
from safedpa_lab.experiments.sensing_curves import CURVES, curves_experiment, curves_page, draw_curves
from safedpa_lab.experiments.sensing_scenes import scene_and_people
from safedpa_sim.sensing import LaserSettings


@pytest.fixture(scope="module")
def result() -> dict[str, Any]:
    curves = {"walking": (0.0, 1.5), "field_of_view": (pi / 2, 2.0 * pi)}
    return curves_experiment([1003, 1004], 2.0, 1, curves=curves)


@pytest.mark.long
def test_a_row_is_of_the_drives_with_its_value(result: dict[str, Any]) -> None:
    rows = {(row["curve"], row["value"]): row for row in result["rows"]}
    assert list(rows) == [("walking", 0.0), ("walking", 1.5), ("field_of_view", pi / 2), ("field_of_view", 2.0 * pi)]
    for (curve, value), row in rows.items():
        drives = [Drive("people", seed, 2.0, 1.5, policy="way_seeker", **{curve: value}) for seed in (1003, 1004)]
        way = sum(run_drive(drive)["way"] for drive in drives)
        assert row["metres_a_minute"] == pytest.approx(60.0 * way / 4.0)
        assert row["drives"] == 2
    plain = [row for row in result["rows"] if row["value"] in (1.5, 2.0 * pi)]
    told = [run_drive(Drive("people", seed, 2.0, 1.5, "told", policy="way_seeker"))["goals"] for seed in (1003, 1004)]
    assert plain[0]["goals_a_minute_told_everything"] == pytest.approx(60.0 * sum(told) / 4.0)
    assert {**plain[0], "curve": "", "value": 0, "median_microseconds": 0} == {
        **plain[1], "curve": "", "value": 0, "median_microseconds": 0
    }, "the values that are as elsewhere are the same drives"  # fmt: skip


def test_what_curves_share_is_driven_once_and_the_progress_comes_to_its_end() -> None:
    told: list[tuple[int, int]] = []
    curves = {"walking": (0.0, 1.5), "noise": (0.02,)}
    curves_experiment([1003], 0.5, 1, lambda done, of: told.append((done, of)), curves=curves)
    assert told == [(done, 4) for done in (1, 2, 3, 4)], "two with the laser, and two with perfect knowledge"


def test_what_a_curve_changes_reaches_the_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[LaserSettings] = []
    whole = sensing.Laser
    monkeypatch.setattr(sensing, "Laser", lambda settings, seed: made.append(settings) or whole(settings, seed))
    usual = Drive("people", 1003, 0.1, 1.5)
    for name in ("noise", "latency", "field_of_view"):
        run_drive(replace(usual, **{name: 0.25}))
        assert made[-1] == replace(LaserSettings(), **{name: 0.25})
    fast = np.array([one.speed for one in moved(3.0)])
    assert (fast <= 3.0).all()
    assert fast.max() > 1.5
    assert max(one.speed for one in moved(0.0)) == 0.0


def moved(walking: float) -> list[Any]:
    """People of a scene after three seconds near a stationary robot, with the greatest speed that each had."""
    scene, people = scene_and_people("people", 1005, "none", walking)
    outline = sensing_outline(scene)
    for one in people:
        one.speed = max(float(np.hypot(*one.velocity(0.05 * tick, (50.0, 50.0), outline))) for tick in range(60))
    return list(people)


def sensing_outline(scene: Any) -> Any:
    from safedpa_sim.sensing.shapes import Outline

    return Outline(scene.obstacles, scene.polygons, (scene.field,))


def test_the_usual_value_is_part_of_each_curve() -> None:
    usual = Drive("people", 0, 1.0, 1.5)
    assert all(getattr(usual, name) in values for name, values in CURVES.items())


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in CURVES.items() for value in values])
def test_every_value_of_every_curve_can_be_driven(name: str, value: float) -> None:
    changed: dict[str, Any] = {name: value}
    assert run_drive(replace(Drive("people", 1003, 0.1, 1.5, policy="way_seeker"), **changed))["moving"] == []


@pytest.mark.long
def test_page_and_picture(result: dict[str, Any], tmp_path: Path) -> None:
    page = curves_page(result)
    assert "| 90 | 2 |" in page
    assert "| 1.5 | 2 |" in page
    assert "noise of a range" not in page
    draw_curves(result, tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 10_000
