"""An order to stop: kept, answered, obeyed by the filter whatever the policy requests, and lifted again."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.adaptation import AdaptationNode
from safedpa.bus import Answer, Request, StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.robots.car.barriers.obstacles import car_barriers
from safedpa.runtime.node import SafetyFilterNode
from safedpa.runtime.stop_orders import EVERYBODY, StopOrders
from safedpa.safety import FilterSettings, SafetyFilter, Status
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.conformal import OnlineMargin
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots import CarRobot, PendulumRobot, Scene, task_named, wind_towards

CAR = load_model("car")
STOP, GO = Request(do="stop", who="a test"), Request(do="go", who="a test")
STATUS = Request(do="status")


def test_a_robot_stands_by_its_own_order_or_by_the_fleets() -> None:
    orders = StopOrders()
    assert orders.reason("r1") == ""
    assert orders.answer("r1", STOP).ok
    assert orders.reason("r1") == "ordered by a test"
    assert orders.reason("r2") == ""
    assert orders.answer(EVERYBODY, STOP).ok
    assert orders.reason("r2") == "ordered by a test"
    refused = orders.answer("r1", GO)
    assert not refused.ok
    assert "whole fleet is stopped" in refused.sentence
    assert "still stopped: r1" in orders.answer(EVERYBODY, GO).sentence
    assert orders.reason("r2") == ""
    assert orders.reason("r1") != "", "the fleet's go lifts the fleet's stop alone"
    assert orders.answer("r1", GO).ok
    assert orders.reason("r1") == ""
    assert not orders.answer("r1", GO).ok
    assert orders.answer("r1", STATUS) == Answer(ok=True, sentence="robot 'r1' may drive")
    assert orders.answer("r1", STOP).ok
    assert orders.answer("r1", STATUS) == Answer(ok=True, sentence="robot 'r1' is stopped, ordered by a test")
    assert orders.answer(EVERYBODY, STATUS).sentence == "the whole fleet may drive; still stopped: r1"
    with pytest.raises(InputError, match="wanted stop, go, confirm or status"):
        orders.answer("r1", Request(do="accept"))


def test_a_localisation_confirms_an_implausible_state_and_ends_no_order_of_a_person() -> None:
    confirm = Request(do="confirm", who="/initialpose")
    orders = StopOrders()
    assert not orders.answer("r1", confirm).ok, "nothing is to be confirmed"
    orders.latch("r1", "it jumped")
    assert orders.answer("r1", confirm).ok
    assert orders.reason("r1") == ""
    for first in (True, False):
        if first:
            orders.answer("r1", STOP)
        orders.latch("r1", "it jumped")
        if not first:
            orders.answer("r1", STOP)
        assert not orders.answer("r1", confirm).ok
        assert "ordered by a test" in orders.reason("r1")
        assert orders.answer("r1", GO).ok
    orders.latch("r1", "it jumped")
    orders.answer(EVERYBODY, STOP)
    assert not orders.answer("r1", confirm).ok
    assert not orders.answer(EVERYBODY, confirm).ok


@settings(max_examples=12)
@given(st.lists(st.tuples(st.sampled_from(["stop", "go"]), st.sampled_from(["a", "b", EVERYBODY])), max_size=12))
def test_a_filter_that_is_started_again_knows_every_order(tmp_path_factory, story):
    path = tmp_path_factory.mktemp("orders") / "orders.json"
    orders = StopOrders(path)
    for do, robot in story:
        orders.answer(robot, Request(do=do, who="a test"))
        assert StopOrders(path).active == orders.active


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"format": 2, "orders": {}}', b'{"format": 1}', b"\xff\xfe"])
def test_orders_that_cannot_be_read_stop_everybody(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "orders.json"
    path.write_bytes(content)
    orders = StopOrders(path)
    assert str(path) in orders.reason("anybody")
    assert orders.answer(EVERYBODY, GO).ok
    assert StopOrders(path).reason("anybody") == ""


def test_answers_say_how_long_an_order_holds(tmp_path: Path) -> None:
    assert "has no file" in StopOrders().answer("r1", STOP).sentence
    assert StopOrders(tmp_path / "orders.json").answer("r1", STOP).sentence.endswith("valid until 'go'")
    lost = StopOrders(tmp_path / "missing" / "orders.json")
    assert "cannot be written" in lost.answer("r1", STOP).sentence
    assert lost.reason("r1") != "", "in force all the same"
    assert "will stop it again" in lost.answer("r1", GO).sentence


def car_filter() -> SafetyFilter:
    chosen = FilterSettings.for_robot("car")
    barriers = car_barriers(chosen, (0.08, 0.40, 0.12), [(2.0, 0.0, 0.3)], (-4, 4, -4, 4))
    return SafetyFilter.for_model(CAR, chosen, barriers)


@pytest.mark.parametrize("state", [[0.4, 0.0, 0.0, 1.2], [1.2, 0.0, 0.0, 0.0], [1.45, 0.0, 0.0, 0.3]])
def test_a_stopped_car_gets_the_brake_and_nothing_else(state: list[float]) -> None:
    verdict = car_filter().stop("a test", state, CAR.latent)
    assert verdict.status is Status.stopped
    np.testing.assert_array_equal(verdict.action, [0.0, 0.0])
    assert verdict.known
    assert "a test" in verdict.sentence
    assert verdict.nominal is None


def test_a_stop_needs_neither_latent_nor_state() -> None:
    for state, latent in (([np.nan] * 4, CAR.latent), ([0.4, 0.0, 0.0, 1.2], None), ("nonsense", None)):
        verdict = car_filter().stop("a test", state, latent, stale=["the latent"])
        assert verdict.status is Status.stopped
        np.testing.assert_array_equal(verdict.action, [0.0, 0.0])


def stopped_between(
    robot: CarRobot | PendulumRobot, name: str, begin: int, end: int, ticks: int, *, enabled: bool = True
) -> list[Tick]:
    model = load_model(name)
    chosen = dataclasses.replace(settings_named(name), enabled=enabled)
    node = SafetyFilterNode(model, chosen, margin_for(model))
    seen = []
    for tick in drive(robot, [AdaptationNode(model), PolicyNode(model), node], ticks):
        seen.append(tick)
        if len(seen) == begin:
            node.orders.answer(EVERYBODY, STOP)
        if len(seen) == end:
            node.orders.answer(EVERYBODY, GO)
    return seen


@pytest.mark.parametrize("enabled", [True, False], ids=["filtered", "switched off"])
def test_a_driving_car_stands_until_it_may_go(enabled: bool) -> None:
    robot = CarRobot(Scene.random(1, "box"), 0.05, True, epoch=1)
    seen = stopped_between(robot, "car", 16, 80, 110, enabled=enabled)
    speeds = [abs(tick.state.values[3]) for tick in seen]
    assert speeds[15] > 0.3, "it drove"
    assert {tick.verdict.status for tick in seen[17:80]} == {"stopped"}
    assert {tick.verdict.ordered for tick in seen[17:80]} == {"ordered by a test"}
    assert {tick.verdict.ordered for tick in (*seen[:16], *seen[81:])} == {""}
    assert max(speeds[60:80]) < 0.02
    places = np.array([tick.state.values[:2] for tick in seen[60:80]])
    assert np.ptp(places, axis=0).max() < 0.01, "it stays where it stands"
    assert "stopped" not in {tick.verdict.status for tick in seen[81:]}
    assert max(speeds[81:]) > 0.3, "it drives again"
    assert all(tick.refusal is None for tick in seen)


def test_a_pendulum_has_no_stand_so_the_corridor_is_kept() -> None:
    robot = PendulumRobot(task_named("balance"), wind_towards(4.0, 135.0), seed=1)
    seen = stopped_between(robot, "pendulum", 50, 500, 160)
    assert robot.collisions == []
    assert {tick.verdict.status for tick in seen[51:]} == {"stopped"}
    torques = [abs(tick.verdict.action[0]) for tick in seen[51:]]
    assert max(torques) > 0.1, "torque 0 would have left the corridor"


def test_a_filter_that_ends_waits_until_the_car_stands() -> None:
    node = SafetyFilterNode(CAR, settings_named("car"), margin_for(CAR))
    robot = CarRobot(Scene.random(1, "none"), 0.05, True, epoch=1)
    rested = []
    for index, tick in enumerate(drive(robot, [AdaptationNode(CAR), PolicyNode(CAR), node], 100)):
        if index == 20:
            node.begin_shutdown()
        rested.append((index > 21 and node.at_rest("r1"), abs(tick.state.values[3])))
    assert not rested[22][0]
    first = next(index for index, (rest, _) in enumerate(rested) if rest)
    assert first < 60, "within two seconds"
    assert all(speed <= 0.02 for rest, speed in rested if rest)
    assert not node.at_rest("a robot never met")


def test_the_state_message_of_a_car_has_no_corridor() -> None:
    state: StateMessage = CarRobot(Scene.random(1, "none"), 0.05, True, epoch=1).state_message()
    assert state.corridor == (), "by this the filter knows that braking brings it to rest"


@settings(max_examples=40)
@given(st.lists(st.floats(-0.1, 0.3), min_size=1, max_size=60), st.integers(1, 20))
def test_coverage_is_the_share_of_steps_in_which_the_margin_held(errors: list[float], window: int) -> None:
    margin = OnlineMargin(0.1, 0.9, window=window)
    assert margin.coverage is None
    held = []
    for error in errors:
        held.append(error <= margin.value)
        margin.update(error)
    reported = margin.coverage
    assert reported is not None
    assert reported == pytest.approx(sum(held[-window:]) / len(held[-window:]))
