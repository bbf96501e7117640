"""Many cars turned by one process: who is late, and whose fault it is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from safedpa.bus import VERDICT, Bus, MemoryTransport, Received, VerdictMessage
from safedpa_sim.robots.contacts import Collision
from safedpa_sim.robots.fleet_loop import FleetLoop, _moments

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


def test_without_services_every_tick_is_late_and_none_of_it_is_the_simulations_fault(stack: Make) -> None:
    fleet = stack(NAMES, nodes=())
    fleet.services = []
    fleet.drive(1.0)
    account = fleet.fleet.account()
    assert account["late_ticks"] == account["robot_ticks"] > 90
    assert account["late_while_held_up"] == 0
    assert account["robots_with_late_ticks"] == 5
    assert all(car.watchdog_ticks == car.tick for car in fleet.cars.values())


def test_what_the_simulation_is_late_by_is_told_apart(stack: Make) -> None:
    fleet = stack(NAMES)
    fleet.drive(0.5)
    fleet.fleet.begin_counting()
    fleet.clock.now += 0.03  # held up; the services too, since one hand turns them all
    fleet.drive(0.5)
    account = fleet.fleet.account()
    assert account["held_up_ticks"] > 0
    assert account["own_lateness_us"]["longest"] > 5_000
    assert account["late_ticks"] == account["late_while_held_up"]


def test_what_is_older_than_two_periods_does_not_begin_to_act(stack: Make) -> None:
    fleet = stack(("a",))
    fleet.drive(0.5)
    car = fleet.cars["a"]
    fleet.fleet.turn()
    while not fleet.fleet._inbox.waiting:  # its state is out, its action comes in, and then this process stands still
        fleet.clock.now += 0.0025
        for service in fleet.services:
            service.turn(0.0)
        if not fleet.fleet._inbox.waiting:
            fleet.fleet.turn()
    before = car.watchdog_ticks
    fleet.clock.now += 0.2
    fleet.fleet.turn()
    assert car.guard.refusals["too old"] == 1
    assert car.watchdog_ticks == before + 1


def test_in_step_all_sense_at_once_else_spread_over_the_period(stack: Make) -> None:
    for in_step, most in ((True, 5), (False, 1)):
        fleet = stack(NAMES, nodes=())
        fleet.services = []
        loop = FleetLoop(fleet.cars, Bus(MemoryTransport(fleet.broker), "test"), in_step=in_step, clock=fleet.clock)
        states: list[int] = []
        for _ in range(20):
            before = sum(loop.lateness.count for _ in (0,))
            loop.turn()
            states.append(loop.lateness.count - before)
            fleet.clock.now += 0.0025
        assert max(states) == most
        assert sum(states) == 5


def test_robots_that_share_a_moment_speak_and_are_answered_in_bundles_as_if_each_were_alone(stack: Make) -> None:
    names = tuple(f"car{index:04d}" for index in range(24))
    fleet = stack(names)
    keys: Counter[str] = Counter()
    MemoryTransport(fleet.broker).subscribe("safedpa/test/*/*", lambda key, _payload: keys.update([key]))
    fleet.drive(1.0)
    assert fleet.fleet.late == 0
    for topic in ("state", "latent", "wish", "action", "verdict"):
        assert keys[f"safedpa/test/+/{topic}"] >= 5 * 18, topic
        assert not [key for key in keys if key.endswith(f"/{topic}") and "/+/" not in key], topic
    alone = stack(names[:1])
    alone.drive(1.0)
    assert alone.cars[names[0]].tick == fleet.cars[names[0]].tick
    assert alone.cars[names[0]].trajectory_hash == fleet.cars[names[0]].trajectory_hash


@pytest.mark.parametrize(("robots", "moments"), [(1, 1), (7, 7), (8, 5), (60, 5), (100, 3), (150, 2), (1000, 2)])
def test_the_more_robots_the_fewer_moments_they_share(robots: int, moments: int) -> None:
    assert _moments(robots) == moments


def test_the_path_is_told_with_every_fourth_tick_and_the_next_state_with_each(stack: Make) -> None:
    fleet = stack(NAMES[:1])
    verdicts = Bus(MemoryTransport(fleet.broker), "test").inbox((VERDICT,), keep_all=True)
    fleet.drive(1.0)
    told = [item.message for item in verdicts.take(0.0) if isinstance(item, Received)]
    rows = {verdict.tick: len(verdict.predicted) for verdict in told if isinstance(verdict, VerdictMessage)}
    assert len(rows) >= 15
    assert rows == {tick: 8 if tick % 4 == 0 else 1 for tick in rows}


def test_nobody_wakes_up_for_an_action_that_came(stack: Make) -> None:
    fleet = stack(NAMES)
    fleet.drive(0.5)
    loop = fleet.fleet
    for _ in range(100):
        moment = loop._next_moment()
        live = [when for when, name, tick, senses in loop._events if senses or loop._turning[name].robot.tick == tick]
        assert moment == min(live)
        fleet.drive(0.0025)


def test_a_collision_is_told_with_robot_place_and_what_the_watchdog_did(stack: Make) -> None:
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
    fleet.services = []  # nobody answers: the watchdog brakes, and the bump comes in the first such tick
    fleet.drive(0.2)
    (told,) = fleet.fleet.account()["collision_list"]
    assert (told["robot"], told["load"], told["part"], told["what"]) == ("b", "box", "car", "wall east")
    assert (told["time"], told["x"], told["y"], told["speed"]) == (1.25, x, y, 0.5)
    assert told["tick"] in range(9, 13)
    assert len(told["braked_before"]) == 10
    assert told["braked_before"][:5] == [False] * 5
