"""Detected objects are drawn with those that limit the action; invalid ones are not drawn."""

from dataclasses import replace

import pytest
from tests.messages import stamp

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.drawing import Discs, Lines, Rings
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.now_page import NowPage
from safedpa_services.dashboard.world import holding_entry, seen_entries
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

SEEN = SurroundingsMessage(
    **stamp(4),
    points=((1.0, 2.0, 0.05), (1.5, 2.0, 0.1)),
    movers=((3.0, 0.5, 0.2, 0.0, 0.0, 1.5),),
    hidden=((-1.0, 0.0, 0.4, 1.5),),
    ages=(0.05,),
)


def state() -> StateMessage:
    scene = Scene(0, None, (-4.0, 4.0, -4.0, 4.0), (), (0.0, 0.0, 0.0))
    return CarRobot(scene, sensor_inputs=SimulatedSensors((Laser(LaserSettings()),))).state_message()


def test_every_disc_is_drawn_with_the_radius_of_its_message() -> None:
    drawn = {entry.path[-1]: entry.shape for entry in seen_entries(SEEN)}
    points, movers, hidden = drawn["at_rest"], drawn["may_move"], drawn["hidden"]
    assert isinstance(points, Discs)
    assert (points.centres, points.radii) == (((1.0, 2.0), (1.5, 2.0)), (0.05, 0.1))
    assert isinstance(movers, Discs)
    assert (movers.centres, movers.radii) == (((3.0, 0.5),), (0.2,))
    assert isinstance(hidden, Rings)
    assert hidden.centres == ((-1.0, 0.0),)


def test_a_line_leads_to_each_disc_that_holds_back() -> None:
    entry = holding_entry(("mover 0", "point 1", "highest speed", "hidden 7"), SEEN, (0.0, 0.0))
    assert isinstance(entry.shape, Lines)
    assert entry.shape.strips == (((0.0, 0.0), (3.0, 0.5)), ((0.0, 0.0), (1.5, 2.0)))
    assert len(entry.shape.colours) == 2
    for nothing in (holding_entry(("mover 0",), None, (0.0, 0.0)), holding_entry(("mover 0",), SEEN, None)):
        assert isinstance(nothing.shape, Lines)
        assert nothing.shape.strips == ()


@pytest.mark.parametrize("row", [(), (1.0,), (float("nan"), 0.0, 0.1), (1.0, 0.0, -0.1), (1e30, 0.0, 0.1)])
def test_what_cannot_be_drawn_is_left_out(row: tuple[float, ...]) -> None:
    odd = replace(SEEN, points=(row, SEEN.points[0]))
    points = seen_entries(odd)[0].shape
    assert isinstance(points, Discs)
    assert points.centres == ((1.0, 2.0),)


def test_the_page_shows_the_age_of_each_source_and_what_is_wrong_with_one() -> None:
    page = NowPage(display_settings(load_model("car"), settings_named("car")))
    page.take(state(), 0.0)
    page.take(replace(SEEN, problems=("the source laser is frozen",)), 0.0)
    text = page.page(0.5).text
    assert "laser 0.55 s old" in text
    assert "the source laser is frozen" in text
    page.take(replace(SEEN, ages=(-1.0,)), 0.0)
    assert "laser no data" in page.page(0.5).text
    assert "**No state for 9 s" in page.page(9.0).text
    assert "laser no data" in page.page(9.0).text


MARKED = replace(
    SEEN,
    zones=("closed wet_floor", "ignored arm", "closed far"),
    borders=((0.0, 1.0, 1.0), (0.0, 2.0, 1.0), (0.0, 2.0, 2.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 0.0, 1.0)),
    ordered="zone wet_floor on, by Ada",
)


def test_zones_are_drawn_by_their_kind_and_listed_with_the_person_who_switched_one() -> None:
    drawn = {entry.path[-1]: entry.shape for entry in seen_entries(MARKED)}["zones"]
    assert isinstance(drawn, Lines)
    assert drawn.strips == (
        ((1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 1.0)),
        ((0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (0.0, 0.0)),
    )
    assert len(set(drawn.colours)) == 2
    page = NowPage(display_settings(load_model("car"), settings_named("car")))
    page.take(state(), 0.0)
    page.take(MARKED, 0.0)
    notice = page.page(0.1).text
    assert "zones: closed wet\\_floor, ignored arm, closed far" in notice
    assert "switched: zone wet\\_floor on, by Ada" in notice
    page.take(SEEN, 0.2)
    assert "switched" not in page.page(0.3).text


@pytest.mark.parametrize("row", [(0.0,), (0.0, float("nan"), 1.0), (0.0, 1e30, 1.0), (7.0, 1.0, 1.0)])
def test_a_border_that_cannot_be_drawn_is_left_out(row: tuple[float, ...]) -> None:
    odd = replace(MARKED, borders=(row, row, row, *MARKED.borders[3:]))
    shape = {entry.path[-1]: entry.shape for entry in seen_entries(odd)}["zones"]
    assert isinstance(shape, Lines)
    assert len(shape.strips) == 1


def test_more_zones_than_a_file_may_have_are_ignored() -> None:
    """A message of 64 KiB can hold 10,000 names and 2,000 vertices; comparing all pairs takes seconds."""
    corners = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))
    borders = tuple((float(number), *corner) for number in range(500) for corner in corners)
    flood = replace(SEEN, zones=("closed a",) * 500, borders=borders, ordered="x" * 50_000, problems=("y" * 50_000,))
    shape = {entry.path[-1]: entry.shape for entry in seen_entries(flood)}["zones"]
    assert isinstance(shape, Lines)
    assert len(shape.strips) == 64
    page = NowPage(display_settings(load_model("car"), settings_named("car")))
    page.take(state(), 0.0)
    page.take(flood, 0.0)
    assert len(page.page(0.1).text) < 2_000
