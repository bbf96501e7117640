"""Many cars turned by one process: which ticks are late, and whether the simulation is the cause."""

from collections import Counter
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest

from safedpa.bus import ACTION, VERDICT, Bus, MemoryTransport, ReceivedMessage, VerdictMessage
from safedpa_sim.robots.car.contacts import Collision
from safedpa_sim.robots.fleet.loop import FleetLoop

Make = Callable[..., Any]
NAMES = tuple(f"car{index}" for index in range(5))


def test_served_in_time_nothing_is_late(stack: Make) -> None:
    fleet = stack(NAMES)
    fleet.drive(1.0)
    account = fleet.fleet.account()
    assert (account["robot_ticks"], account["late_ticks"], account["held_up_ticks"]) == (100, 0, 0)
    assert account["collisions"] == 0
    assert account["refusals"] == {}
    assert 0 <= account["sense_to_act_us"]["p50"] <= account["sense_to_act_us"]["longest"] <= 45_000


def test_without_services_every_tick_is_late_but_not_by_the_simulation(stack: Make) -> None:
    fleet = stack(NAMES, nodes=())
    fleet.services = []
    fleet.drive(1.0)
    account = fleet.fleet.account()
    assert account["late_ticks"] == account["robot_ticks"] > 90
    assert account["late_while_held_up"] == 0
    assert account["robots_with_late_ticks"] == 5
    assert all(car.watchdog_ticks == car.tick for car in fleet.cars.values())


def test_the_simulations_own_lateness_is_counted_apart(stack: Make) -> None:
    fleet = stack(NAMES)
    fleet.drive(0.5)
    fleet.fleet.begin_counting()
    fleet.clock.now += 0.03  # held up; the services too, since one hand turns them all
    fleet.drive(0.5)
    account = fleet.fleet.account()
    assert account["held_up_ticks"] > 0
    assert account["own_lateness_us"]["longest"] > 5_000
    assert account["late_ticks"] == account["late_while_held_up"]


def test_an_action_older_than_two_periods_does_not_begin_to_act(stack: Make) -> None:
    fleet = stack(("a",))
    fleet.drive(0.5)
    car = fleet.cars["a"]
    actions = fleet.bus().inbox((ACTION,), clock=fleet.clock)
    fleet.fleet.step()
    while not actions.take(0.0):  # its state is out, its action comes, and then this process is held up
        fleet.fleet.step()
        fleet.clock.now += 0.0025
        for service in fleet.services:
            service.turn(0.0)
    before = car.watchdog_ticks
    fleet.clock.now += 0.2
    fleet.fleet.step()
    assert car.guard.refusals["too old"] == 1
    assert car.watchdog_ticks == before + 1


def sensed_together(stack: Make, robots: int, *, in_step: bool = False) -> list[int]:
    """How many of a fleet's robots sense at each of their moments within a period; one car stands for all of them."""
    fleet = stack(("a",), nodes=())
    cars = dict.fromkeys((f"car{index}" for index in range(robots)), fleet.cars["a"])
    loop = FleetLoop(cars, Bus(MemoryTransport(fleet.broker), "test"), in_step=in_step, clock=fleet.clock)
    counts = [0]
    for _ in range(19):
        loop.step()
        counts.append(loop.lateness.count)
        fleet.clock.now += 0.0025
    return [later - sooner for sooner, later in pairwise(counts) if later > sooner]


def test_in_step_all_sense_at_once_else_spread_over_the_period(stack: Make) -> None:
    assert sensed_together(stack, 5, in_step=True) == [5]
    assert sensed_together(stack, 5) == [1] * 5


@pytest.mark.parametrize(("robots", "moments"), [(1, 1), (7, 7), (8, 5), (60, 5), (100, 3), (150, 2), (1000, 2)])
def test_the_more_robots_the_fewer_moments_they_share(stack: Make, robots: int, moments: int) -> None:
    together = sensed_together(stack, robots)
    assert (len(together), sum(together)) == (moments, robots)
    assert max(together) - min(together) <= 1


def test_robots_that_share_a_moment_are_bundled_and_drive_as_if_each_were_alone(stack: Make) -> None:
    names = tuple(f"car{index:04d}" for index in range(24))
    fleet = stack(names)
    keys: Counter[str] = Counter()
    MemoryTransport(fleet.broker).subscribe("safedpa/test/*/*", lambda key, _payload: keys.update([key]))
    fleet.drive(1.0)
    assert fleet.fleet.late == 0
    for topic in ("state", "latent", "nominal", "action", "verdict"):
        assert keys[f"safedpa/test/+/{topic}"] >= 5 * 18, topic
        assert not [key for key in keys if key.endswith(f"/{topic}") and "/+/" not in key], topic
    alone = stack(names[:1])
    alone.drive(1.0)
    assert alone.cars[names[0]].tick == fleet.cars[names[0]].tick
    assert alone.cars[names[0]].trajectory_hash == fleet.cars[names[0]].trajectory_hash


def test_the_path_is_published_every_fourth_tick_and_the_next_state_every_tick(stack: Make) -> None:
    fleet = stack(NAMES[:1])
    verdicts = Bus(MemoryTransport(fleet.broker), "test").inbox((VERDICT,), keep_all=True)
    fleet.drive(1.0)
    reported = [item.message for item in verdicts.take(0.0) if isinstance(item, ReceivedMessage)]
    rows = {verdict.tick: len(verdict.predicted) for verdict in reported if isinstance(verdict, VerdictMessage)}
    assert len(rows) >= 15
    assert rows == {tick: 8 if tick % 4 == 0 else 1 for tick in rows}


def test_a_collision_is_reported_with_robot_position_and_what_the_watchdog_did(stack: Make) -> None:
    fleet = stack(("a", "b"))
    fleet.drive(0.5)
    car = fleet.cars["b"]
    x, y, _, _ = car.values
    advance = car.world.advance

    def bump(*action: float) -> None:
        advance(*action)
        car.world.contacts.collisions.append(Collision(1.25, "car", "wall east", x, y, 0.5, 0.5))
        car.world.advance = advance

    car.world.advance = bump
    fleet.services = []  # no answer: the watchdog brakes, and the bump comes in the first such tick
    fleet.drive(0.2)
    (reported,) = fleet.fleet.account()["collision_list"]
    assert (reported["robot"], reported["load"], reported["part"], reported["what"]) == ("b", "box", "car", "wall east")
    assert (reported["time"], reported["x"], reported["y"], reported["speed"]) == (1.25, x, y, 0.5)
    assert reported["tick"] in range(9, 13)
    assert len(reported["braked_before"]) == 10
    assert reported["braked_before"][:5] == [False] * 5
