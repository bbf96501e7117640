"""How much there is to do, which seeds there are, and what a scene is made of, counted by hand."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.errors import InputError
from safedpa_lab.experiments import car_curves, margins
from safedpa_lab.experiments.car_scenes import car_scene
from safedpa_lab.experiments.margin_drives import DriveOrder, DriveResult
from safedpa_lab.experiments.seeds import seeds_for


def made(order: DriveOrder) -> DriveResult:
    return DriveResult(order.seed, {}, goals=order.seed, collisions=0, ticks=1, statuses={}, least_h=0.5)


def drives(folder: Path, seeds: list[int], told: list[tuple[int, int]], ends: float = float("inf")) -> list[int]:
    """Whose results come back; progress of 9 that are to be done, 2 of them elsewhere before."""
    count = margins._Count(9, lambda *one: told.append(one), 2)
    workers: Any = SimpleNamespace(map=map)
    orders = [DriveOrder("car", seed, None) for seed in seeds]
    return [one.seed for one in margins._driven(folder, orders, workers, ends, count)]


def test_drives_that_are_kept_count_as_done_at_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    asked: list[int] = []

    def driven(order: DriveOrder) -> DriveResult:
        asked.append(order.seed)
        return made(order)

    monkeypatch.setattr(margins, "driven", driven)
    told: list[tuple[int, int]] = []
    assert drives(tmp_path, [5, 3], told) == [5, 3]
    assert told == [(2, 9), (3, 9), (4, 9)]
    told.clear()
    assert drives(tmp_path, [1, 5, 2, 3, 4], told) == [1, 5, 2, 3, 4]
    assert told == [(4, 9), (5, 9), (6, 9), (7, 9)]
    assert asked == [5, 3, 1, 2, 4], "none of them twice"
    told.clear()
    assert drives(tmp_path, [1, 2], told) == [1, 2]
    assert told == [(4, 9)]


def test_where_time_is_over_what_is_kept_comes_back_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(margins, "driven", made)
    told: list[tuple[int, int]] = []
    drives(tmp_path, [5, 3], [])
    assert drives(tmp_path, [1, 3, 2, 5], told, ends=-1.0) == [3, 5]
    assert told == [(4, 9)]


@pytest.mark.parametrize(
    ("sweeps", "places"), [(("noise",), 0), (("noise", "speed"), -1), (("delay", "delay_untold"), -1)]
)
@pytest.mark.parametrize("methods", [1, 3])
def test_curves_are_every_method_at_every_place_and_what_calibrates_them(
    sweeps: tuple[str, ...], places: int, methods: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forty drives calibrate; without any change all sweeps meet in one place, which is driven once."""

    class ReachedError(Exception):
        pass

    def workers(_: int) -> Any:
        raise ReachedError

    asked: list[int] = []
    monkeypatch.setattr(car_curves, "Calibration", lambda *_: SimpleNamespace(size=40))
    monkeypatch.setattr(car_curves, "Workers", workers)
    monkeypatch.setattr(car_curves, "_Count", lambda total, _: asked.append(total))
    names: Any = [f"method {number}" for number in range(methods)]
    monkeypatch.setattr(car_curves.CarCurves, "drivable", lambda _: (names, []))
    with pytest.raises(ReachedError):
        car_curves.car_curves(car_curves.CarCurves(Path(), sweeps=sweeps, episodes=7))
    values = sum(len(sweep.values) for sweep in car_curves.chosen_sweeps(sweeps)) + places
    assert asked == [40 + values * methods * 7]


@pytest.mark.parametrize(("purpose", "first"), [("development", 0), ("calibration", 10**6), ("evaluation", 2 * 10**6)])
def test_a_hundred_thousand_seeds_are_of_each_purpose(purpose: str, first: int) -> None:
    assert seeds_for(purpose, 100_000) == range(first, first + 100_000)
    assert seeds_for(purpose, 3, 99_997) == range(first + 99_997, first + 100_000)
    assert len(seeds_for(purpose, 0, 100_000)) == 0
    for count, skip in ((100_001, 0), (1, 100_000), (4, 99_997), (-1, 5), (5, -1)):
        with pytest.raises(InputError, match=rf"got {skip} \+ {count}, wanted at most 100000"):
            seeds_for(purpose, count, skip)


@pytest.mark.parametrize("load", ["none", "chair"])
def test_three_to_five_obstacles_stand_between_start_and_goal(load: str) -> None:
    """As many as were drawn: each number comes up, and no other."""
    counts = Counter(len(car_scene(seed, load, passage=0.05).obstacles) for seed in range(24))
    assert set(counts) == {3, 4, 5}
    assert counts == Counter(len(car_scene(seed, load, passage=0.05).obstacles) for seed in range(24))
