"""Where people may hide: no person that a ray would have hit, and every person that none would have."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.bus.wire.messages import ScanMessage
from safedpa.errors import InputError
from safedpa.perception.grid import CELL, Grid
from safedpa.perception.hiding import Hiding
from safedpa.perception.settings import PerceptionSettings
from safedpa.perception.sweep import Sweep
from safedpa.perception.things import Things
from safedpa_sim.sensing.shapes import Outline, box, cast, rooms_to

SLIMMEST = 0.2
ROOM = (-4.0, 4.0, -4.0, 4.0)


def state() -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=0,
        robot_time=0.0,
        publish_time=0.0,
        values=(0.0, 0.0, 0.0, 0.0),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=True,
        goal=(0.0, 0.0),
        obstacles=(),
        field=(),
        footprint=(),
    )


def sweep(ranges: np.ndarray, field_of_view: float = 2.0 * pi) -> Sweep:
    """From the origin, the first ray straight behind."""
    scan = ScanMessage(
        epoch=1,
        tick=0,
        robot_time=0.0,
        publish_time=0.0,
        source="laser",
        mount=(0.0, 0.0, 0.0),
        first_angle=-0.5 * field_of_view,
        angle_step=field_of_view / len(ranges),
        ranges=tuple(ranges.tolist()),
        nearest=0.05,
        farthest=12.0,
        number=0,
    )
    return Sweep(scan, (0.0, 0.0, 0.0), state(), open_air=False)


def looked(one: Sweep) -> Things:
    things = Things(PerceptionSettings(), 0.0, 0.0)
    things.take(one, np.zeros((things.grid.size, things.grid.size), dtype=bool))
    return things


def hidden(things: Things, places: np.ndarray) -> np.ndarray:
    i, j, _ = things.grid.cells(places)
    found: np.ndarray = things.hiding.present[i, j]
    return found


@pytest.mark.parametrize("dropped", [2, 3])
def test_between_dropped_rays_no_person_hides_while_others_pass(dropped: int) -> None:
    """Every other ray measures nothing: a body of 0.4 m would have stood in one of those that do."""
    ranges = np.full(360, 3.0)
    ranges[::dropped] = -1.0
    draw = np.random.default_rng(1)
    distance, turn = draw.uniform(0.3, 2.5, 500), draw.uniform(-pi, pi, 500)
    places = np.column_stack([distance * np.cos(turn), distance * np.sin(turn)])
    assert not hidden(looked(sweep(ranges)), places).any()


def test_a_person_may_hide_where_a_whole_sector_is_dropped() -> None:
    ranges = np.full(360, 3.0)
    ranges[170:191] = -1.0
    assert hidden(looked(sweep(ranges)), np.array([[2.0, 0.0]])).all()


@pytest.mark.parametrize("rays", [90, 360, 1080])
def test_a_person_whom_no_ray_hits_is_accounted_for(rays: int) -> None:
    """Places for a body of 0.2 m among pillars and a box, drawn at random."""
    draw = np.random.default_rng(rays)
    outline = Outline(
        ((1.5, 0.5, 0.3), (-1.0, 1.4, 0.25), (0.3, -1.8, 0.2)), (box(-1.5, -1.0, 0.9, 0.4, 0.5),), (ROOM,)
    )
    angles: np.ndarray = -pi + 2.0 * pi / rays * np.arange(rays, dtype=np.float64)
    ranges = cast(outline, 0.0, 0.0, angles)
    things = looked(sweep(ranges))
    places = draw.uniform(-3.7, 3.7, (6000, 2))
    places = places[(rooms_to(outline, places) > SLIMMEST + 0.15) & (np.hypot(*places.T) > 0.5)]
    along = places[:, :1] * np.cos(angles) + places[:, 1:] * np.sin(angles)
    across = places[:, 1:] * np.cos(angles) - places[:, :1] * np.sin(angles)
    chord = SLIMMEST**2 - across**2
    meets = (along > 0.0) & (chord > 0.0)
    hit = (meets & (along - np.sqrt(np.maximum(chord, 0.0)) < ranges)).any(axis=1)
    assert (~hit).sum() > 50
    assert hidden(things, places[~hit]).all()
    if rays == 360:
        assert hidden(things, places[hit]).mean() < 0.1


def test_one_ray_past_the_middle_of_a_cell_rules_out_a_person_anywhere_in_it() -> None:
    width = Hiding(11, SLIMMEST, 1.5).width
    grid = Grid(5.0, 0.0, 0.0)
    x, y = (part[3, 4] for part in grid.middles)
    draw = np.random.default_rng(3)
    for turn in draw.uniform(-pi, pi, 200):
        ray = np.array((x, y)) + width * np.array((np.cos(turn), np.sin(turn)))
        centres = np.array((x, y)) + draw.uniform(-CELL / 2, CELL / 2, (50, 2))
        assert (np.hypot(*(centres - ray).T) <= SLIMMEST + 1e-9).all()


def test_the_farthest_past_a_place_is_the_most_of_the_rays_that_pass_it() -> None:
    draw = np.random.default_rng(4)
    for field_of_view, rays in ((2.0 * pi, 120), (4.0, 90)):
        ranges = draw.uniform(0.5, 6.0, rays)
        one = sweep(ranges, field_of_view)
        angles = -0.5 * field_of_view + field_of_view / rays * np.arange(rays)
        places = draw.uniform(-3.0, 3.0, (400, 2))
        found = one.farthest_past(places[:, 0], places[:, 1], 0.12)
        along = places[:, :1] * np.cos(angles) + places[:, 1:] * np.sin(angles)
        across = np.abs(places[:, 1:] * np.cos(angles) - places[:, :1] * np.sin(angles))
        most = np.where((across <= 0.12 + 1e-9) & (along > 0.0), ranges, 0.0).max(axis=1)
        assert (found <= most + 1e-9).all()
        assert (found == most).mean() > 0.6


@pytest.mark.parametrize("slimmest", [0.1, 0.15, 0.2])
def test_next_to_the_robot_a_person_may_hide_unless_they_would_stand_in_it(slimmest: float) -> None:
    hiding, grid, draw = Hiding(21, slimmest, 1.5), Grid(1.0, 0.0, 0.0), np.random.default_rng(6)
    nothing, own = np.zeros((21, 21), dtype=bool), np.zeros((21, 21), dtype=bool)
    own[8:12, 9:12] = True
    hiding.look(0.0, nothing, nothing, own, nothing)
    x, y = grid.middles
    for i, j in np.argwhere(~hiding.present):
        centres = np.array((x[i, j], y[i, j])) + draw.uniform(-CELL / 2, CELL / 2, (50, 2))
        apart = np.hypot(centres[:, :1] - x[own], centres[:, 1:] - y[own])
        assert (apart.min(axis=1) <= slimmest + 1e-9).all()


@pytest.mark.parametrize("slimmest", [0.1, 0.2])
def test_in_an_empty_room_no_person_hides_however_slim(slimmest: float) -> None:
    things = Things(PerceptionSettings(slimmest=slimmest), 0.0, 0.0)
    things.take(sweep(np.full(360, 4.5)), np.zeros((things.grid.size, things.grid.size), dtype=bool))
    assert not things.hiding.present[np.hypot(*things.grid.middles) < 2.0].any()


def test_what_is_slimmer_than_a_cell_is_refused() -> None:
    with pytest.raises(InputError, match=r"slimmest: got 0\.09, wanted 0\.1 to 5"):
        PerceptionSettings(slimmest=0.09)
