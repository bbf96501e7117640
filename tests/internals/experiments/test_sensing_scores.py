"""The geometry of what a laser hits: scores of whole drives reach each branch by chance alone."""

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa_lab.experiments.sensing import scores as sensing_scores
from safedpa_lab.experiments.sensing.scenes import _outside
from safedpa_sim.sensing.shapes import Outline

SQUARE, OTHER = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)], [(3.0, 0.0), (5.0, 0.0), (5.0, 1.0), (3.0, 1.0)]


@pytest.mark.parametrize(
    ("place", "outside"),
    [((0.5, 0.5), False), ((4.0, 0.5), False), ((2.0, 0.5), True), ((0.5, 1.5), True), ((-0.1, 0.5), True)],
)
def test_a_position_is_free_if_it_lies_in_none_of_the_boxes(place: tuple[float, float], outside: bool) -> None:
    both = Outline((), (SQUARE, OTHER), ())  # type: ignore[arg-type]
    assert _outside(both, *place) is outside
    assert _outside(Outline((), (), ()), *place)


@pytest.mark.parametrize(
    ("discs", "away"),
    [
        ([[3.0, 4.0, 1.0]], 4.0), ([[3.0, 4.0, 1.0], [0.0, 2.0, 0.5]], 1.5),
        ([[0.0, 0.2, 0.5], [0.0, 2.0, 0.5]], -0.3), ([], 1e3),
    ],
)  # fmt: skip
def test_the_nearest_disc_and_where_there_is_none_far_away(discs: list[list[float]], away: float) -> None:
    assert sensing_scores._to(np.array(discs).reshape(-1, 3), np.zeros(2)) == pytest.approx(away)


@pytest.mark.parametrize(
    ("wanted", "who"), [("111", 1), ("101", 2), ("100", 0), ("001", 2), ("000", None), ("", None), ("11", 1)]
)
def test_the_wanted_person_nearest_to_the_boundary_is_reported(wanted: str, who: int | None) -> None:
    h = np.array([0.75, -0.25, 0.5])[: len(wanted)]
    assert sensing_scores._nearest(h, np.array([letter == "1" for letter in wanted], dtype=bool)) == who


@pytest.mark.parametrize(
    ("ranges", "own", "hit"),
    [
        ((9.0, 9.0, 9.0, 1.5), "", True), ((9.0, 9.0, 9.0, 1.55), "", True), ((9.0, 9.0, 9.0, 1.65), "", False),
        ((9.0, 9.0, 9.0, 1.35), "", False), ((1.5, 1.5, 1.5, 9.0), "", False), ((9.0, 9.0, 9.0, 1.5), "all", False),
    ],
)  # fmt: skip
def test_a_person_is_seen_if_a_ray_ends_on_him_and_not_on_the_robot(ranges, own, hit, monkeypatch):
    """A disc of 0.5 m, 2 m to the right, at the end of the last of four rays; ``own``: the robot itself is there."""
    monkeypatch.setattr(sensing_scores, "within_body", lambda found, *_: np.full(len(found), bool(own)))
    scan: Any = SimpleNamespace(
        mount=(0.0, 0.0, 0.0), first_angle=0.0, angle_step=math.pi / 2.0, nearest=0.05, ranges=ranges
    )
    assert sensing_scores._hit(scan, (0.0, 0.0, 0.0), None, (0.0, -2.0, 0.5)) is hit  # type: ignore[arg-type]


def test_one_of_several_rays_on_a_person_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensing_scores, "within_body", lambda found, *_: np.arange(len(found)) == 0)
    scan: Any = SimpleNamespace(
        mount=(0.0, 0.0, 0.0), first_angle=-0.1, angle_step=0.1, nearest=0.05, ranges=(1.5,) * 3
    )
    assert sensing_scores._hit(scan, (0.0, 0.0, 0.0), None, (2.0, 0.0, 0.5))  # type: ignore[arg-type]
