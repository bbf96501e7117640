"""The policy's step: stamped nominal actions, nominal actions at random, and the planner, alone and as a controller."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.messages import latent_of, stamp, state_of

from safedpa.bus import LATENT, NOMINAL, LatentMessage, NominalMessage, Stale, StateMessage
from safedpa.dynamics import fingerprint, load_model
from safedpa.errors import InputError, MessageError
from safedpa.policy import PolicyNode
from safedpa.policy.controller import NetworkLatent, RandomActions, controller_for
from safedpa.robots.car.controllers.goal_seeker import GoalSeekerSettings
from safedpa.robots.car.controllers.mppi import Planner, PlannerSettings
from safedpa.robots.car.controllers.time_to_goal import PlanningGrid, TimeToGo, clearance, grid_distances
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.driving.controllers import controllers_experiment
from safedpa_services.command_line import up
from safedpa_services.supervisor.plan import Plan
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

MODEL = load_model("car")
LIMITS = GoalSeekerSettings()
FOOTPRINT = (0.08, 0.40, 0.12)
STATE = state_of(0.0, 0.0, 0.0, 0.5, **stamp(7, epoch=5), applied=(0.5, 0.0), goal=(1.0, 0.5), footprint=FOOTPRINT)


def latent(mass_ratio: float, **changes: Any) -> LatentMessage:
    values = list(MODEL.latent)
    values[MODEL.latent_names.index("towed_load.mass_ratio")] = mass_ratio
    return dataclasses.replace(latent_of(*values, **stamp(7, epoch=5), model=fingerprint(MODEL)), **changes)


def nominal(state: StateMessage, known: LatentMessage | Stale) -> NominalMessage:
    message = PolicyNode(MODEL).step("r", state, {LATENT: known})[NOMINAL]
    assert isinstance(message, NominalMessage)
    return dataclasses.replace(message, publish_time=0.0)


def test_the_nominal_action_carries_the_stamp_of_its_state_and_asks_for_more_speed_with_a_heavier_load() -> None:
    message = nominal(STATE, Stale(LATENT, 3))
    assert (message.epoch, message.tick, message.robot_time) == (5, 7, STATE.robot_time)
    assert message.controller == "goal_seeker:seek"
    assert message == nominal(STATE, Stale(LATENT, 3))
    without, light, heavy = (nominal(STATE, known).values for known in (Stale(LATENT, None), latent(0.0), latent(0.8)))
    assert light == pytest.approx(without, abs=1e-6), "at the values of the model's file nothing is to be made up for"
    assert heavy[0] > light[0]
    assert heavy[1] == light[1]


@pytest.mark.parametrize("mass_ratio", [0.0, 1.0, 5.0])
@pytest.mark.parametrize("speed", [-0.5, 0.0, 2.0])
def test_made_up_or_not_it_stays_within_the_limits_of_the_actuators(mass_ratio: float, speed: float) -> None:
    for goal in ((3.0, 0.0), (-3.0, 1.0), (0.2, 0.6)):
        state = dataclasses.replace(STATE, values=(0.0, 0.0, 0.0, speed), goal=goal)
        target, steer = nominal(state, latent(mass_ratio)).values
        assert LIMITS.slowest_target <= target <= LIMITS.fastest_target
        assert abs(steer) <= LIMITS.steer_limit


@pytest.mark.parametrize("change", [{"model": "another"}, {"values": (0.5,) * 9}, {"values": ()}])
def test_a_latent_that_does_not_fit_is_left_aside(change: dict[str, Any]) -> None:
    assert nominal(STATE, latent(0.8, **change)) == nominal(STATE, Stale(LATENT, None))


@pytest.mark.parametrize(
    "change", [{"values": (0.0,) * 3}, {"goal": (1.0,)}, {"goal": (1.0, 2.0, 3.0)}, {"values": ()}]
)
def test_a_state_of_the_wrong_length_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(MessageError, match="wanted 4 and 2"):
        nominal(dataclasses.replace(STATE, **change), Stale(LATENT, None))


def test_robots_are_kept_apart_and_forgotten() -> None:
    node = PolicyNode(MODEL)
    for tick in range(60):
        state = dataclasses.replace(STATE, tick=tick, robot_time=0.05 * tick)
        held = node.step("held", state, {LATENT: Stale(LATENT, None)})[NOMINAL]
    assert isinstance(held, NominalMessage)
    assert held.controller != "goal_seeker:seek"
    assert node.step("new", STATE, {LATENT: Stale(LATENT, None)})[NOMINAL].controller == "goal_seeker:seek"  # type: ignore[attr-defined]
    node.forget("held")
    assert node.step("held", STATE, {LATENT: Stale(LATENT, None)})[NOMINAL].controller == "goal_seeker:seek"  # type: ignore[attr-defined]


def state(tick: int, values: tuple[float, ...]) -> StateMessage:
    return state_of(*values, tick=tick, applied=(0.0,), period=0.01, goal=(0.0,), field=(), footprint=())


@pytest.mark.parametrize(
    ("model", "values", "low", "high"),
    [
        ("pendulum", (0.1, 0.2), (-10.0,), (10.0,)),
        ("car", (0.0, 1.0, 2.0, 0.5), (-0.6, -0.34), (2.0, 0.34)),
        ("point", (0.0, 0.0), (-0.015, -3.0), (0.015, 3.0)),
    ],
)
def test_they_are_uniform_over_the_bounds(model: str, values: tuple[float, ...], low: Any, high: Any) -> None:
    own = load_model(model)
    low, high = (own.system.action_low, own.system.action_high) if low is None else (low, high)
    nominal_actions = RandomActions(own)
    values = (*values, *(0.0 for _ in range(len(own.system.state) - len(values))))
    drawn = np.array([nominal_actions.nominal_action(state(tick, values), None)[0] for tick in range(2000)])
    share = (drawn - low) / (np.array(high) - low)
    assert share.min() >= 0.0
    assert share.max() <= 1.0
    assert np.quantile(share, [0.25, 0.5, 0.75], axis=0) == pytest.approx(
        np.array([[0.25], [0.5], [0.75]]) * np.ones(drawn.shape[1]), abs=0.05
    )


def test_they_repeat_for_the_same_state_and_differ_between_states() -> None:
    model = load_model("pendulum")
    one = RandomActions(model).nominal_action(state(7, (0.1, 0.2)), None)
    assert one == RandomActions(model).nominal_action(state(7, (0.1, 0.2)), np.zeros(2))
    assert one != RandomActions(model).nominal_action(state(8, (0.1, 0.2)), None)
    assert one != RandomActions(model).nominal_action(state(7, (0.1, -0.2)), None)
    assert one[1] == "random"


def test_a_pendulum_nominal_actions_at_random_until_its_model_has_a_policy() -> None:
    physics, learned = load_model("pendulum"), load_model("pendulum_learned")
    assert isinstance(controller_for(physics)(), RandomActions)
    assert isinstance(controller_for(learned)(), NetworkLatent), "backing off is what a car does"
    assert isinstance(controller_for(learned, "random")(), RandomActions)
    for name in ("goal_seeker", "planner"):
        with pytest.raises(InputError, match="known: learned, random"):
            controller_for(physics, name)
    with pytest.raises(InputError, match="no networks"):
        controller_for(physics, "learned")


def plan(controller: str) -> Plan:
    return Plan(
        robot="car", name="r1", load="none", seconds=1.0, seed=0, rate=20.0, lockstep=True, filtered=True,
        dashboard=False, model="car", settings="car", margin="", controller=controller, fleet="fleet",
        endpoint="tcp/127.0.0.1:1", folder=Path(),
    )  # fmt: skip


def test_the_policy_service_starts_with_the_chosen_controller_unless_its_model_cannot_have_it(tmp_path: Path) -> None:
    policy = next(child for child in plan("planner").services() if child.name == "policy")
    at = policy.arguments.index("--controller")
    assert policy.arguments[at + 1] == "planner"
    assert all("--controller" not in child.arguments for child in plan("").services())
    result = CliRunner().invoke(up.command, ["--controller", "learned", "--headless", "--out", str(tmp_path)])
    assert "no networks" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_the_node_sends_the_planners_nominal_action() -> None:
    state = CarRobot(Scene.random(3, "none"), 0.05).state_message()
    node = PolicyNode(load_model("car"), controller="planner")
    nominal = node.step("r1", state, {LATENT: Stale(LATENT, None)})[NOMINAL]
    assert isinstance(nominal, NominalMessage)
    assert nominal.controller == "planner"
    assert len(nominal.values) == 2


@pytest.mark.long
def test_a_small_comparison_counts_every_drive() -> None:
    reported: list[tuple[int, int, dict[str, Any]]] = []
    result = controllers_experiment(
        load_model("car"),
        settings_named("car"),
        ("goal_seeker", "planner"),
        (201,),
        3.0,
        lambda *at: reported.append(at),
    )
    assert [(row["load"], row["controller"]) for row in result["rows"][:2]] == [
        ("none", "goal_seeker"),
        ("none", "planner"),
    ]
    assert reported == [(1, 1, result)]
    assert all(row["drives"] == 1 and row["collisions"] == 0 for row in result["rows"])
    assert all(row["milliseconds_p99"] >= row["milliseconds_p50"] > 0.0 for row in result["rows"])


@pytest.mark.parametrize("name", ["planer", ""])
def test_unknown_controllers_are_refused(name: str) -> None:
    with pytest.raises(Exception, match="controller"):
        PolicyNode(load_model("car"), controller=name)


FIELD = (-4.0, 4.0, -4.0, 4.0)
NO_OBSTACLES = np.zeros((0, 3))


WALL = tuple((0.0, y, 0.3) for y in (-0.9, -0.3, 0.3, 0.9))
"""A wall of discs across the straight way, open at both ends."""


def message(
    values: tuple[float, ...],
    goal: tuple[float, ...],
    obstacles: tuple[tuple[float, ...], ...] = (),
    applied: tuple[float, ...] = (0.0, 0.0),
) -> StateMessage:
    return state_of(*values, applied=applied, goal=goal, obstacles=obstacles, field=FIELD, footprint=FOOTPRINT)


def driven(
    start: tuple[float, ...], goal: tuple[float, float], obstacles: tuple[tuple[float, ...], ...] = (),
    seconds: float = 15.0, seed: int = 0,
) -> tuple[float, float, list[tuple[float, ...]]]:  # fmt: skip
    """Drives without a filter; returns the time to the goal (or infinity), the smallest clearance, and the actions."""
    planner, state, nominal = Planner(MODEL, seed=seed), np.array(start), (0.0, 0.0)
    room, nominal_actions = math.inf, []
    for tick in range(round(seconds / 0.05)):
        pose = tuple(np.array([value]) for value in state[:3])
        ends = (np.array([-FOOTPRINT[0]]), np.array([FOOTPRINT[1]]))
        found = clearance(pose, ends, np.array(obstacles).reshape(-1, 3), FIELD)
        room = min(room, float(found[0]) - FOOTPRINT[2])
        if math.dist(state[:2], goal) < 0.3:
            return tick * 0.05, room, nominal_actions
        nominal, name = planner.nominal_action(message(tuple(state.tolist()), goal, obstacles, nominal), MODEL.latent)
        assert name == "planner"
        nominal_actions.append(nominal)
        state = MODEL.step(state, np.array(nominal), MODEL.latent)
    return math.inf, room, nominal_actions


@pytest.mark.parametrize("yaw", [0.0, 1.5, -1.5, 3.1])
def test_it_reaches_a_goal_in_an_empty_field(yaw: float) -> None:
    seconds, room, _ = driven((-2.0, 0.0, yaw, 0.0), (2.0, 0.5))
    assert seconds < 9.0
    assert room > 0.0


def test_a_goal_behind_a_wall_or_out_of_a_dead_end_is_reached() -> None:
    """Straight towards the goal there is no way: a controller that only looks one second ahead stays there."""
    seconds, room, _ = driven((-2.0, 0.0, 0.0, 0.0), (2.0, 0.0), WALL)
    assert seconds < 10.0
    assert room > 0.0
    pocket = (*WALL, (-0.6, 1.2, 0.3), (-0.6, -1.2, 0.3), (-1.2, 1.2, 0.3), (-1.2, -1.2, 0.3))
    seconds, room, _ = driven((-1.2, 0.0, 0.0, 0.0), (2.0, 0.0), pocket, 25.0)
    assert seconds < 25.0
    assert room > -0.02


def test_the_same_seed_drives_the_same_drive_and_the_time_mirrors_with_its_scene() -> None:
    start, goal = (-2.0, 0.0, 0.3, 0.0), (2.0, 0.0)
    first, again, other = (driven(start, goal, WALL, 2.0, seed)[2] for seed in (3, 3, 4))
    assert first == again
    assert first != other
    obstacles = np.array([(0.5, 0.7, 0.3), (-1.0, -0.4, 0.2)])
    one, other = settled((2.0, 1.0), obstacles), settled((2.0, -1.0), obstacles * (1, -1, 1))
    x, y, yaw = np.random.default_rng(0).uniform(-3.8, 3.8, (3, 200))
    assert one(x, y, yaw) == pytest.approx(other(x, -y, -yaw), rel=1e-3, abs=0.02)


@given(
    some.tuples(some.floats(-4, 4), some.floats(-4, 4), some.floats(-7, 7), some.floats(-1, 2.3)),
    some.tuples(some.floats(-4, 4), some.floats(-4, 4)),
    some.integers(0, 6),
)
@settings(max_examples=25, deadline=None)
def test_whatever_it_sees_it_stays_within_its_limits(values: tuple[float, ...], goal: tuple[float, float], count: int):
    random = np.random.default_rng(count)
    obstacles = tuple(map(tuple, np.column_stack([random.uniform(-4, 4, (count, 2)), np.full(count, 0.3)]).tolist()))
    planner, limits = Planner(MODEL), PlannerSettings()
    for latent in (None, MODEL.latent):
        (speed, steer), _ = planner.nominal_action(message(values, goal, obstacles), latent)
        assert limits.slowest_target <= speed <= limits.fastest_target
        assert abs(steer) <= limits.steer_limit


def test_states_that_do_not_fit_are_refused() -> None:
    good = message((0.0, 0.0, 0.0, 0.0), (1.0, 1.0))
    planner = Planner(MODEL)
    for wrong in ({"values": (0.0, 0.0)}, {"goal": (1.0,)}, {"applied": ()}, {"field": ()}, {"footprint": (1.0,)}):
        with pytest.raises(MessageError, match="wanted"):
            planner.nominal_action(dataclasses.replace(good, **wrong), None)  # type: ignore[arg-type]
    with pytest.raises(MessageError, match="the model diverges"):
        planner.nominal_action(dataclasses.replace(good, values=(0.0, 0.0, 0.0, math.nan)), None)


@pytest.mark.parametrize(
    "wrong", [{"samples": 0}, {"temperature": -1.0}, {"knots": 1}, {"slowest_target": 3.0}, {"room": math.nan}]
)
def test_impossible_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError, match="planner"):
        PlannerSettings(**wrong)  # type: ignore[arg-type]


@given(some.tuples(some.floats(-3, 3), some.floats(-3, 3)))
@settings(max_examples=40, deadline=None)
def test_a_free_way_is_nearly_straight(goal: tuple[float, float]) -> None:
    """Eight neighbours lengthen a way by 8.2 % at most; around the goal it is exact."""
    grid = PlanningGrid(FIELD, 0.2)
    found = grid_distances(grid, goal, np.ones((len(grid.x), len(grid.y))))
    straight = np.hypot(grid.x[:, None] - goal[0], grid.y[None, :] - goal[1])
    assert (found >= straight - 0.3).all()
    assert (found <= 1.083 * straight + 0.3).all()


def settled(goal: tuple[float, float], obstacles: np.ndarray, speeds: tuple[float, float] = (1.5, 0.4)) -> TimeToGo:
    to_go = TimeToGo(goal, obstacles, (-6.0, 6.0, -6.0, 6.0), FOOTPRINT, 0.1)
    to_go.drive_at(*speeds)
    rounds = 0
    while not to_go.settled:
        to_go.relax(1)
        rounds += 1
        assert rounds < 300
    return to_go


def time(to_go: TimeToGo, x: float, y: float, yaw: float) -> float:
    return float(to_go(np.array(x), np.array(y), np.array(yaw)))


def test_the_time_is_the_way_over_the_speed_and_longer_for_a_turn_or_round_a_wall() -> None:
    to_go = settled((3.0, 0.0), NO_OBSTACLES)
    assert time(to_go, -1.0, 0.0, 0.0) == pytest.approx(4.0 / 1.5, rel=0.08)
    # A goal 0.8 m behind: 2 s in reverse at 0.4 m/s; with a reverse gear that is dead, half a circle and more.
    to_go = settled((0.0, 0.0), NO_OBSTACLES)
    assert time(to_go, 3.0, 0.0, 0.0) > time(to_go, 3.0, 0.0, math.pi) + 0.8
    assert time(to_go, 1.2, 0.0, 0.0) == pytest.approx(1.2 / 0.4, rel=0.25)
    dead = settled((0.0, 0.0), NO_OBSTACLES, (1.5, 0.01))
    assert time(dead, 1.2, 0.0, 0.0) > time(to_go, 1.2, 0.0, 0.0) + 0.5
    to_go = settled((1.5, 0.0), np.array(WALL))
    assert time(to_go, -1.5, 0.0, 0.0) > 2 * math.hypot(1.5, 1.4) / 1.5


def test_clearance_is_that_of_the_segment() -> None:
    random = np.random.default_rng(2)
    obstacles = np.column_stack([random.uniform(-3, 3, (5, 2)), random.uniform(0.1, 0.4, 5)])
    x, y, yaw = random.uniform((-3, -3, -np.pi), (3, 3, np.pi), (50, 3)).T
    found = clearance((x, y, yaw), (np.full(50, -0.2), np.full(50, 0.7)), obstacles, FIELD)
    along = np.linspace(-0.2, 0.7, 2001)[:, None]
    px, py = x + along * np.cos(yaw), y + along * np.sin(yaw)
    room = np.min([px + 4, 4 - px, py + 4, 4 - py], axis=0)
    for ox, oy, radius in obstacles:
        room = np.minimum(room, np.hypot(px - ox, py - oy) - radius)
    assert found == pytest.approx(room.min(axis=0), abs=1e-3)
