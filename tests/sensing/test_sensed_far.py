"""What a car's sensors see, chosen in one pass: all that h of every disc, asked one by one, says is near."""

from __future__ import annotations

from dataclasses import replace
from math import inf, nan

import numpy as np
import pytest

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.errors import InputError
from safedpa.robots.car.barriers import ObstacleBarrier, braking_of
from safedpa.robots.car.quickness import ORDINARY
from safedpa.robots.car.sensed_barrier import MoverBarrier
from safedpa.robots.car.sensed_far import below, discs_near, far_of, fastest_of, moving_near
from safedpa.robots.car.sensed_scene import MOST_ROWS, counter_braking_of, sensed_barriers
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.safety.shipped import settings_named
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene

SETTINGS = settings_named("car")
COUNTER, BRAKING, CLEARANCE = counter_braking_of(SETTINGS), braking_of(SETTINGS), SETTINGS.barrier("clearance")
BODY = (0.08, 0.40, 0.17)
TOWED = TowedReach(0.1, 0.5, 0.2, 0.3, (0.0, 0.0, 0.0))
FOLDED = TowedReach(0.1, 0.5, 0.9, 0.5, (0.0, 0.0, 0.0))
"""A large load that was pushed back as far as it folds."""
MARGINS = {"obstacle": 0.02, "mover": 0.03}
POINTS, MOVERS, HIDDEN = 3, 6, 4
Rows = tuple[tuple[float, ...], ...]


def state_of(values: tuple[float, ...]) -> StateMessage:
    told = CarRobot(Scene(0, None, (-9.0, 9.0, -9.0, 9.0), (), (0.0, 0.0, 0.0))).state_message()
    return replace(told, values=values, footprint=BODY)


def seen_by(state: StateMessage, points: Rows = (), movers: Rows = (), hidden: Rows = ()) -> SurroundingsMessage:
    return SurroundingsMessage(
        epoch=state.epoch,
        tick=state.tick,
        robot_time=state.robot_time,
        publish_time=0.0,
        points=points,
        movers=movers,
        hidden=hidden,
        ages=(0.0,),
    )


def scene(draw: np.random.Generator, count: int) -> tuple[StateMessage, SurroundingsMessage]:
    """A car near the origin, and ``count`` discs of each kind up to 6 m around."""
    values = (*draw.uniform(-0.3, 0.3, 2), draw.uniform(-4.0, 4.0), draw.uniform(-0.6, 2.0))
    state = state_of(tuple(float(value) for value in values))

    def rows(*more: float) -> Rows:
        angle, distance = draw.uniform(-np.pi, np.pi, count), draw.uniform(0.2, 6.0, count)
        sizes = draw.uniform(0.0, 0.3, count)
        table = np.column_stack([distance * np.cos(angle), distance * np.sin(angle), sizes])
        return tuple((*row, *more) for row in table.tolist())

    return state, seen_by(state, rows(), rows(0.1, 0.0, 1.5), rows(0.9))


def every_height(state: StateMessage, seen: SurroundingsMessage, towed: TowedReach | None) -> dict[str, float]:
    """Of each disc the h that says whether it is near, less how large it has to be: below 0 it is."""
    still = ObstacleBarrier(np.reshape(seen.points, (-1, 3)), BODY, BRAKING, CLEARANCE, towed=towed)
    discs = [(x, y, radius, w) for x, y, radius, *_, w in (*seen.movers, *seen.hidden)]
    thick = {} if towed is None else {"towed": towed, "own_radius": SETTINGS.barrier("own_radius")}
    able = MoverBarrier(discs, [False] * len(discs), BODY, BRAKING, COUNTER, CLEARANCE, state.period, **thick)
    names = [f"point {row}" for row in range(len(seen.points))]
    names += [f"mover {row}" for row in range(len(seen.movers))]
    names += [f"hidden {row}" for row in range(len(seen.hidden))]
    found = []
    for barrier in (still, able):
        far = far_of(barrier, state, SETTINGS.eta, MARGINS[barrier.kind], 0.0, ORDINARY)
        found += (barrier.values(np.array(state.values)) - far).tolist()
    return dict(zip(names, found, strict=True))


@pytest.mark.parametrize("towed", [None, TOWED, FOLDED])
@pytest.mark.parametrize("count", [1, 12, 30])
def test_all_that_is_near_is_looked_at_and_nothing_else(count: int, towed: TowedReach | None) -> None:
    draw, near, far = np.random.default_rng([4, count]), 0, 0
    for _ in range(60):
        state, seen = scene(draw, count)
        heights = every_height(state, seen, towed)
        found = sensed_barriers(SETTINGS, COUNTER, state, seen, towed, MARGINS)
        wanted = {name for name, height in heights.items() if height < 0.0}
        assert set(found.barriers.names) - {"highest speed", "lowest speed"} == wanted
        near, far = near + len(wanted), far + len(heights) - len(wanted)
    assert near > 20
    assert far > 20


def test_of_too_many_those_with_the_least_h_are_looked_at() -> None:
    draw = np.random.default_rng(6)
    state = state_of((0.0, 0.0, 0.3, 1.0))
    table = np.column_stack([draw.uniform(-1.5, 1.5, (300, 2)), np.full(300, 0.05)])
    found = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, tuple(map(tuple, table.tolist()))), None)
    still = ObstacleBarrier(table, BODY, BRAKING, CLEARANCE)
    speeds = (1.0, SETTINGS.barrier("speed_low"), SETTINGS.barrier("speed_high"))
    least = np.min([still.values(np.array((0.0, 0.0, 0.3, speed))) for speed in speeds], axis=0)
    wanted = sorted(np.argsort(least)[:MOST_ROWS].tolist())
    assert found.barriers.parts[0].names == tuple(f"point {row}" for row in wanted)
    assert found.left_out.startswith("Of ")


def test_only_the_discs_that_count_give_barriers() -> None:
    state = state_of((0.0, 0.0, 0.0, 0.5))
    near, away = (1.2, 0.2, 0.1, 0.0, 0.0, 0.5), (30.0, 0.0, 0.1, 0.0, 0.0, 1.5)
    found = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, ((0.9, 0.5, 0.1),), (away, near)), None)
    creeps, own = SETTINGS.barrier("creeping"), SETTINGS.barrier("own_radius")
    known = BODY, BRAKING, COUNTER, CLEARANCE, state.period
    able = MoverBarrier([(1.2, 0.2, 0.1, 0.5)], [False], *known, ["mover 1"], creeps=creeps, own_radius=own)
    still = ObstacleBarrier([(0.9, 0.5, 0.1)], BODY, BRAKING, CLEARANCE, ["point 0"])
    for one, wanted in zip(found.barriers.parts[:2], (still, able), strict=True):
        assert (one.names, one.shared, one.each) == (wanted.names, wanted.shared, wanted.each)


@pytest.mark.parametrize(("speed", "told"), [(0.1, ""), (0.11, "somebody whom nobody sees may be")])
def test_only_a_moving_car_yields_to_hidden_people(speed: float, told: str) -> None:
    state, place = state_of((0.0, 0.0, 0.0, speed)), (0.6, 0.0, 0.1)
    assert sensed_barriers(SETTINGS, COUNTER, state, seen_by(state), None).yields_to == ""
    hidden = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, hidden=((*place, 1.5),)), None)
    assert hidden.yields_to.startswith(told)
    assert bool(hidden.yields_to) is bool(told)
    away, near = (30.0, 0.0, 0.1, 0.0, 0.0, 1.5), (*place, 0.0, 0.0, 1.5)
    seen = sensed_barriers(SETTINGS, COUNTER, state, seen_by(state, (), (away, near)), None)
    assert seen.yields_to == "mover 1 may be at the robot before it stands"


def test_for_a_state_of_another_length_every_disc_counts() -> None:
    state = state_of((0.0, 0.0, 0.0, 0.0, 0.0))
    seen = seen_by(state, ((90.0, 0.0, 0.1),), ((90.0, 0.0, 0.1, 0.0, 0.0, 1.5),), ((90.0, 0.0, 0.1, 1.5),))
    found = sensed_barriers(SETTINGS, COUNTER, state, seen, None)
    assert found.barriers.names == ("point 0", "mover 0", "hidden 0", "highest speed", "lowest speed")
    assert found.yields_to == ""


def test_discs_reach_to_their_rim_and_room() -> None:
    rows = ((3.0, 0.0, 0.5), (0.0, -3.0, 0.5), (3.0, 0.0, 0.6))
    assert discs_near(rows, 0.0, 0.0, 2.4, 0.1) == ([2], [(3.0, 0.0, 0.7)])
    assert discs_near(rows, 0.0, 0.0, 2.4 + 1e-9, 0.1)[0] == [0, 1, 2]
    assert discs_near(rows, 0.0, 0.0, inf, 0.1)[0] == [0, 1, 2]
    assert discs_near((), 0.0, 0.0, inf, 0.1) == ([], [])


def test_what_moves_comes_nearer_while_the_car_stops() -> None:
    movers, hidden = ((3.0, 0.0, 0.1, 0.0, 0.0, 1.5),), ((-3.0, 0.0, 0.1, 1.0), (0.0, 3.0, 0.1, 0.5))
    place = (0.0, 0.0, 2.0)
    rows, discs, everywhere = moving_near(movers, hidden, place, 0.7, 0.2, 0.1)
    assert rows == [0, 1]
    assert discs == [(3.0, 0.0, pytest.approx(0.45), 1.5, 1.5), (-3.0, 0.0, pytest.approx(0.4), 1.0, 0.0)]
    assert everywhere == [(-3.0, 0.0, pytest.approx(0.4), 1.0, 1.0)]
    assert moving_near(movers, hidden, place, inf, 0.2, 0.1)[0] == [0, 1, 2]
    assert fastest_of(movers, hidden) == 1.5
    assert fastest_of((), hidden) == 1.0
    assert fastest_of((), ()) == 0.0


def test_below_is_less_and_a_number_that_is_none_is_not() -> None:
    assert below([1.0, 0.5, nan, -2.0, 1.0], 1.0) == [1, 3]


@pytest.mark.parametrize(("name", "width"), [("points", POINTS), ("movers", MOVERS), ("hidden", HIDDEN)])
def test_rows_that_are_no_discs_are_refused(name: str, width: int) -> None:
    good = (1.0,) * width

    def told(*rows: tuple[float, ...]) -> None:
        if name == "points":
            discs_near(rows, 0.0, 0.0, 1.0, 0.1)
        else:
            fastest_of(rows if name == "movers" else (), rows if name == "hidden" else ())

    told(good, good)
    for bad in ((1.0,) * (width - 1), (1.0,) * (width + 1), ()):
        with pytest.raises(InputError, match=f"{name}: got rows of other lengths, wanted {width} numbers each"):
            told(good, bad)
    for place in range(width):
        for number in (nan, inf, -inf):
            with pytest.raises(InputError, match=f"{name}: got NaN or infinity, wanted finite"):
                told(good, (*good[:place], number, *good[place + 1 :]))
    for place in {2, width - 1}:
        with pytest.raises(InputError, match=f"{name}: got a radius or a speed below 0, wanted 0 or more"):
            told((*good[:place], -0.1, *good[place + 1 :]), good)
    told((1e308,) * width, (1e308,) * width)  # whose sum is no finite number
