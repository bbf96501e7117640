"""What experiments count, from drives that are written down by hand."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments import sensing, wheels
from safedpa_lab.experiments.point_figures import _path
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_sim.robots.contacts import Collision


def drive(seed: int, collisions: int, **more: Any) -> dict[str, Any]:
    usual = {"goals": 2, "way": 3.0, "least_h": 0.5, "statuses": {"passed": 4}, "microseconds": 100.0}
    return {"seed": seed, "collisions": collisions} | usual | more


def test_each_number_of_drives_on_wheels_by_hand() -> None:
    """Five drives, of which two meet something, one of them three times."""
    drives = [
        drive(10, 0), drive(11, 3, least_h=-0.2, statuses={"passed": 1, "fallback": 2}), drive(12, 0, goals=0, way=0.5),
        drive(13, 1, least_h=-0.1, microseconds=900.0), drive(14, 0, microseconds=50.0),
    ]  # fmt: skip
    told = wheels._summary(drives)
    assert (told["drives"], told["drives_with_a_collision"], told["collisions"], told["which"]) == (5, 2, 4, [11, 13])
    assert told["share_95"] == wilson_interval(2, 5)
    assert (told["goals"], told["metres"], told["least_h"]) == (8, 12.5, -0.2)
    assert told["median_microseconds"] == 100.0
    assert told["statuses"] == {"fallback": 2, "passed": 17}


@pytest.mark.parametrize("hit", [0, 1, 7])
def test_as_many_drives_meet_something_as_are_named(hit: int) -> None:
    told = wheels._summary([drive(seed, int(seed < hit)) for seed in range(7)])
    assert told["drives_with_a_collision"] == len(told["which"]) == told["collisions"] == hit


def test_drives_on_wheels_are_told_by_world_and_policy_and_by_whether_they_are_filtered(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Four seeds: the first is driven without the filter as well; every drive is counted once."""
    monkeypatch.setattr(
        wheels, "run_drive", lambda wanted: drive(wanted.seed, int(not wanted.filtered)) | dataclasses.asdict(wanted)
    )
    document = wheels.wheels_experiment([5, 6, 7, 8], 1.0)
    assert len(document["rows"]) == len(wheels.WORLDS) * len(wheels.POLICIES)
    for row in document["rows"]:
        assert (row["filter_on"]["drives"], row["filter_on"]["drives_with_a_collision"]) == (4, 0)
        assert (row["filter_off"]["drives"], row["filter_off"]["which"]) == (1, [5])


@pytest.mark.parametrize("speeds", [(), (0.0,), (0.4, 0.0, 0.0), (0.4, 0.9), (0.0, 0.0)])
def test_who_is_walked_into_is_counted_apart_from_who_drives_into_something(
    speeds: tuple[float, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of every collision it is told once whose it was."""
    hits = [dataclasses.replace(HIT, speed=speed) for speed in speeds]
    robot = SimpleNamespace(collisions=hits, goals_reached=3, trajectory_hash="t")
    monkeypatch.setattr(sensing, "CarRobot", lambda *_, **__: robot)
    monkeypatch.setattr(sensing, "drive", lambda *_: iter([TICK] * 4))
    told = sensing.run_drive(sensing.Drive("pillars", 1000, 0.2, 1.5))
    moving = [speed for speed in speeds if speed >= sensing.STANDS]
    assert (len(told["moving"]), told["standing"]) == (len(moving), len(speeds) - len(moving))
    assert told["goals"] == 3
    assert told["way"] == pytest.approx(4 * 0.05 * 0.8)
    assert told["kept"] == pytest.approx(0.5), "of a wish of 1.0 the filter leaves 0.5"
    assert told["microseconds"] == 300.0


HIT = Collision(time=1.0, part="car", what="obstacle 3", x=0.0, y=0.0, speed=0.0, towards=0.0)
VERDICT = SimpleNamespace(wish=(1.0, 0.0), action=(0.5, 0.0), microseconds=300.0)
TICK = SimpleNamespace(verdict=VERDICT, state=SimpleNamespace(values=(0.0, 0.0, 0.0, -0.8)))


class Axes:
    """Remembers which discs and words are put where; whatever else is asked of it, it does nothing."""

    def __init__(self) -> None:
        self.discs: list[tuple[float, float]] = []
        self.words: list[str] = []
        self.titles: list[str] = []

    def add_patch(self, patch: Any) -> None:
        if not patch.get_fill():
            self.discs.append(tuple(patch.center))

    def text(self, _x: float, _y: float, words: str, **_: Any) -> None:
        self.words.append(words)

    def set_title(self, title: str, **_: Any) -> None:
        self.titles.append(title)

    def __getattr__(self, name: str) -> Any:
        return _nothing


def _nothing(*_: Any, **__: Any) -> SimpleNamespace:
    return SimpleNamespace(set_visible=lambda _: None)


@pytest.mark.parametrize(("reached_at", "drawn"), [([], 1), ([40], 2), ([40, 120, 499], 4), ([40, 120, 500, 700], 3)])
def test_goals_of_a_path_are_those_it_reached_within_ten_seconds_and_the_next(
    reached_at: list[int], drawn: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa_lab.experiments.point_figures.bare", lambda _: None)
    goals = [(0.1 * number, 1.0) for number in range(6)]
    within = np.arange(900) % 10 == 0
    shown = {
        "places": np.zeros((900, 2)).tolist(), "within": within.tolist(), "hazards": [(0.5, 0.5)], "goals": goals,
        "reached_at": reached_at,
    }  # fmt: skip
    axes: Any = Axes()
    _path(axes, shown, "SafeDPA")
    assert axes.discs == goals[:drawn]
    assert axes.words == [str(number) for number in range(1, drawn + 1)]
    assert axes.titles == ["SafeDPA: 50 steps within"]
