"""What the filter makes of a state message: corridors, what is towed and how far it reaches, the car's body."""

import math
from dataclasses import replace
from math import hypot
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers.body import TrailerEnvelope, body_of, grad_bound, hitch_of
from safedpa.robots.car.barriers.obstacles import (
    FieldBarrier,
    ObstacleBarrier,
    braking_of,
    car_barriers,
    swept_capsule,
    with_towed_load,
)
from safedpa.robots.car.barriers.reverse_odometer import ReverseOdometer
from safedpa.robots.car.scenes.perceived import CarScene
from safedpa.robots.pendulum.scene import PendulumScene
from safedpa.runtime import scene as scenes
from safedpa.runtime.scene import AbstractScene, DeclaredScene, scene_of
from safedpa.safety import Barriers, CorridorBarrier, FilterSettings, FunctionBarrier
from safedpa.safety.defaults import settings_named
from safedpa.safety.settings import parse_settings, write_settings

SETTINGS = settings_named("car")
BRAKING = braking_of(SETTINGS)
FOOTPRINT, FIELD = (0.08, 0.40, 0.25), (-4.0, 4.0, -4.0, 4.0)
TOWED = (0.1, 0.5, 0.42)


def towed(way: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TrailerEnvelope:
    return TrailerEnvelope(TOWED[0], TOWED[1], TOWED[2] - FOOTPRINT[2], way, pose)


def growth(load: TrailerEnvelope, x: float, y: float, speed: float) -> float:
    """m by which the radius at the hitch is larger."""
    shared = (*FOOTPRINT[:2], BRAKING.deceleration, BRAKING.gain, *load.numbers)
    given = Given((x, y, 0.0, speed), shared, ())
    hitch = hitch_of(body_of(given, FLOATS), given, FLOATS)
    assert hitch is not None
    return float(hitch[1])


def test_the_growth_follows_the_way_and_the_stop_to_come() -> None:
    most = TOWED[2] - FOOTPRINT[2]
    assert growth(towed(0.05), 0.0, 0.0, 1.0) == 0.0
    assert growth(towed(0.3), 0.0, 0.0, 1.0) == pytest.approx(most / 2)
    assert growth(towed(0.3), -0.1, 0.0, 0.0) == pytest.approx(0.75 * most), "10 cm farther back"
    assert growth(towed(0.3), 0.1, 0.0, 0.0) == pytest.approx(0.25 * most), "10 cm forwards again"
    assert growth(towed(0.2), 0.0, 0.0, -0.32) == pytest.approx(most / 2), "the stop takes 10 cm"
    assert growth(towed(0.9), 0.0, 0.0, -0.6) == most


def test_the_way_is_measured_along_the_heading_of_then_from_where_it_was() -> None:
    most = TOWED[2] - FOOTPRINT[2]
    assert growth(towed(0.3, (1.0, 2.0, math.pi / 2)), 5.0, 2.1, 0.0) == pytest.approx(0.25 * most)
    assert growth(towed(0.3, (1.0, 2.0, 0.0)), 0.9, 5.0, 0.0) == pytest.approx(0.75 * most)


def scene(draw: np.random.Generator) -> tuple[np.ndarray[Any, Any], TrailerEnvelope, list[Any]]:
    state = np.array([*draw.uniform(-3, 3, 2), draw.uniform(-4, 4), draw.uniform(-0.6, 2.0)])
    pose = (state[0] + draw.normal(0, 0.02), state[1] + draw.normal(0, 0.02), state[2] + draw.normal(0, 0.05))
    load = towed(draw.uniform(0.0, 0.6), pose)
    obstacles = np.column_stack([draw.uniform(-3.5, 3.5, (5, 2)), draw.uniform(0.2, 0.35, 5)])
    return state, load, car_barriers(SETTINGS, FOOTPRINT, obstacles, FIELD, load)


def test_braking_straight_lowers_no_h_of_an_obstacle_while_it_reverses() -> None:
    draw, period = np.random.default_rng(4), 0.05
    for _ in range(100):
        state, _, parts = scene(draw)
        state[3] = -abs(state[3]) / 3.0
        before = Barriers(parts).h(state)[:5]
        for _ in range(20):  # the weakest brake that is promised, in small steps
            for _ in range(50):
                size = abs(state[3])
                state[:2] += state[3] * np.array([math.cos(state[2]), math.sin(state[2])]) * period / 50
                state[3] += min(BRAKING.gain * size, BRAKING.deceleration) * period / 50
            after = Barriers(parts).h(state)[:5]
            assert (before - after).max() < 1e-5, "but for the size of the steps"
            before = after


def message(tick: int, x: float, y: float = 0.0, yaw: float = 0.0, **other: Any) -> StateMessage:
    given: dict[str, Any] = {"obstacles": ((2.0, 0.0, 0.3),), "footprint": FOOTPRINT, "towed": TOWED, **other}
    return StateMessage(
        **{
            "epoch": 1, "tick": tick, "robot_time": 0.05 * tick, "publish_time": 0.0, "values": (x, y, yaw, 0.0),
            "applied": (0.0, 0.0), "applied_by": "filter", "period": 0.05, "lockstep": True, "goal": (1.0, 0.0),
            "field": FIELD, **given,
        }
    )  # fmt: skip


def test_the_way_is_unknown_first_then_forgotten_forwards_and_counted_backwards() -> None:
    way = ReverseOdometer()
    way.follow(message(0, 0.0))
    assert way.way >= TOWED[1], "no one knows how the load hangs"
    way.follow(message(1, 0.2))
    assert way.way == pytest.approx(TOWED[1] - 0.2) or way.way == pytest.approx(TOWED[1])
    for tick, x in ((2, 0.6), (3, 1.0), (4, 1.4)):
        way.follow(message(tick, x))
    assert way.way == 0.0
    way.follow(message(5, 1.3))
    way.follow(message(5, 1.3))
    assert way.way == pytest.approx(0.1), "the same state twice counts once"
    way.follow(message(6, 1.3, 0.3))
    assert way.way == pytest.approx(0.1), "sideways is neither"
    way.follow(message(7, math.nan))
    way.follow(message(8, 0.1, 0.3))
    assert way.way == TOWED[1], "more than this is not remembered"


@pytest.mark.parametrize("later", [message(30, 3.0), message(9, 3.0, epoch=2), message(9, 3.0, towed=(0.1, 0.6, 0.5))])
def test_a_robot_that_was_not_watched_may_have_been_reversed(later: StateMessage) -> None:
    way = ReverseOdometer()
    for tick in range(9):
        way.follow(message(tick, 0.2 * tick))
    assert way.way == 0.0
    way.follow(later)
    assert way.way >= later.towed[1]


def test_the_barriers_of_a_robot_that_tows_follow_its_way() -> None:
    room = []
    reports = CarScene(SETTINGS)
    places = [*np.arange(0.0, 1.0, 0.1), *np.arange(0.9, 0.2, -0.1)]
    for tick, x in enumerate(places):
        found = reports.of(message(tick, float(x), obstacles=((x - 0.08, 1.0, 0.2),)))
        assert not isinstance(found, str)
        room.append(found.h_floats((float(x), 0.0, 0.0, 0.0))[0])
    assert room[9] == pytest.approx(1.0 - 0.2 - FOOTPRINT[2] - SETTINGS.barrier("clearance"))
    assert room[-1] == pytest.approx(1.0 - 0.2 - TOWED[2] - SETTINGS.barrier("clearance")), (
        "0.7 m back: its whole reach"
    )


def test_a_way_counts_from_the_first_state_on_and_over_half_a_second_without_one() -> None:
    way = ReverseOdometer()
    way.follow(message(0, 0.2, towed=()))
    assert way.way == 1.0, "before it nothing was seen"
    way.follow(message(10, 0.5, towed=()))
    assert way.way == pytest.approx(0.7), "half a second later"
    way.follow(message(21, 0.9, towed=()))
    assert way.way == 1.0
    way.follow(message(22, 0.0, values=(1.1, 0.0, 0.0), towed=()))
    assert way.way == pytest.approx(0.8), "place and heading are enough"
    way.follow(message(23, 1.1, towed=(), distance_reversed=0.0))
    assert way.way == 0.0, "reported by the robot"


def test_lengths_at_their_limits() -> None:
    for lengths in ((0.0, 0.5, 0.42), (0.1, 1.0, 0.42)):
        assert ReverseOdometer().reach(message(0, 0.0, towed=lengths)) is not None
    assert ReverseOdometer().reach(message(0, 0.0, towed=(0.1, 0.5, FOOTPRINT[2]))) is None, (
        "no more than the footprint"
    )


@pytest.mark.parametrize("wrong", [(0.1, 0.5), (0.5, 0.5, 0.4), (0.5, 0.1, 0.4), (-0.1, 0.5, 0.4), (0.1, 1.5, 0.4)])
def test_lengths_that_are_none_are_no_scene(wrong: tuple[float, ...]) -> None:
    found = CarScene(FilterSettings.for_robot("car")).of(message(0, 0.0, towed=wrong))
    assert isinstance(found, str)
    assert "towed" in found
    with pytest.raises(InputError, match="towed"):
        ReverseOdometer().reach(message(0, 0.0, towed=wrong))


def test_a_filter_that_is_started_again_believes_the_robot_that_counts_itself() -> None:
    old, new, unknowing = ReverseOdometer(), ReverseOdometer(), ReverseOdometer()
    for tick in range(9):
        old.follow(message(tick, 0.2 * tick))
    old.follow(message(9, 1.5))
    assert old.way == pytest.approx(0.1)
    new.follow(message(60, 1.5, distance_reversed=old.way))
    unknowing.follow(message(60, 1.5))
    assert new.way == old.way
    assert unknowing.way == TOWED[1], "without a report it must be assumed to be folded up"
    new.follow(message(61, 1.5, distance_reversed=7.0))
    assert new.way == TOWED[1], "more than this is not remembered"
    new.follow(message(62, 1.6, distance_reversed=math.nan))
    assert new.way == pytest.approx(TOWED[1] - 0.1), "no number: it counts itself"


DEFAULTS, BODY = FilterSettings.for_robot("car"), (0.08, 0.40, 0.12)
ROOM, OBSTACLES = (-3.0, 3.0, -3.0, 3.0), [(1.0, 0.5, 0.3), (-2.0, 0.0, 0.2)]
MESSAGE = StateMessage(
    epoch=1, tick=0, robot_time=0.0, publish_time=0.0, values=(0.0, 0.0, 0.0, 0.0), applied=(0.0, 0.0),
    applied_by="none", period=0.05, lockstep=True, goal=(1.0, 1.0), obstacles=(), field=(), footprint=BODY,
)  # fmt: skip


def distance_to_stop(speed: float) -> float:
    """By small steps of a car that loses what it can: b, and at low speed k v."""
    way, step, braking = 0.0, 1e-4, braking_of(DEFAULTS)
    while speed > 1e-6:
        way += speed * step
        speed -= min(braking.deceleration, braking.gain * speed) * step
    return way


@pytest.mark.parametrize("speed", [-0.7, -0.1, 0.0, 0.3, 1.7])
def test_the_body_is_stretched_to_where_the_car_is_driving_by_as_far_as_it_needs_to_stop(speed: float) -> None:
    found = swept_capsule(replace(MESSAGE, values=(0.3, -0.2, 1.1, speed)), DEFAULTS)
    assert found is not None
    more = distance_to_stop(abs(speed))
    wanted = (-0.08, 0.40 + more, 0.12) if speed > 0.0 else (-0.08 - more, 0.40, 0.12)
    assert found == pytest.approx(wanted, abs=1e-3)


@pytest.mark.parametrize(
    "changed",
    [
        {"footprint": ()}, {"footprint": (0.1, 0.2, 0.3, 0.4)}, {"values": (0.0, 0.0, 0.0)},
        {"values": (0.0, 0.0, 0.0, np.nan)}, {"values": (np.inf, 0.0, 0.0, 0.0)},
    ],
)  # fmt: skip
def test_an_unknown_body_is_not_reported(changed: dict[str, tuple[float, ...]]) -> None:
    assert swept_capsule(replace(MESSAGE, **changed), DEFAULTS) is None  # type: ignore[arg-type]


@pytest.mark.parametrize("field", [ROOM, None])
def test_barriers_of_a_load_that_was_moved_on_are_those_of_a_new_stack(field: tuple[float, ...] | None) -> None:
    random = np.random.default_rng(1)
    before, after = (TrailerEnvelope(0.1, 0.5, 0.2, way, (0.1 * way, 0.2, way)) for way in (0.0, 0.4))
    old, new = (car_barriers(DEFAULTS, BODY, OBSTACLES, field, towed) for towed in (before, after))
    found = with_towed_load(old, after)  # type: ignore[arg-type]
    assert [type(part) for part in found] == [type(part) for part in new]
    assert found[-1] is old[-1]
    differ = 0
    for state in random.uniform((-1.0, -1.0, -3.0, -0.8), (1.0, 1.0, 3.0, 1.0), (40, 4)):
        for part, wanted, former in zip(found, new, old, strict=True):
            np.testing.assert_array_equal(part.h(state), wanted.h(state))
            differ += not np.array_equal(wanted.h(state), former.h(state))
    assert differ > 10


def test_a_load_that_has_not_folded_claims_no_room() -> None:
    """Wherever the car stands or reverses: h is that of the car alone, of obstacles and of walls."""
    braking = braking_of(DEFAULTS)
    for state in np.random.default_rng(2).uniform((-1.0, -1.0, -3.0, -0.3), (1.0, 1.0, 3.0, 1.0), (60, 4)):
        towed = TrailerEnvelope(0.3, 0.6, 0.2, 0.0, tuple(state[:3].tolist()))
        pairs = (
            (FieldBarrier(ROOM, BODY, braking), FieldBarrier(ROOM, BODY, braking, towed=towed)),
            (
                ObstacleBarrier(OBSTACLES, BODY, braking),
                ObstacleBarrier(OBSTACLES, BODY, braking, towed=towed),
            ),
        )
        for alone, with_load in pairs:
            np.testing.assert_allclose(with_load.h(state), alone.h(state), rtol=0.0, atol=1e-12)


def test_no_slope_exceeds_the_stated_bound_and_unread_states_have_slope_zero() -> None:
    braking, random = braking_of(DEFAULTS), np.random.default_rng(3)
    for state in random.uniform((-1.0, -1.0, -3.0, -0.8), (1.0, 1.0, 3.0, 2.0), (60, 4)):
        part = ObstacleBarrier([(*random.uniform(-1.0, 1.0, 2), 0.1)], BODY, braking)
        reported = grad_bound(Given([*state.tolist(), 7.0], part.shared, (), part.form), FLOATS)
        assert reported[4:] == [0.0]
        _, gradient = part.h_and_grad(state)
        assert (np.abs(gradient[0]) <= np.array(reported[:4]) + 1e-9).all()
        assert hypot(*gradient[0, :2]) <= 1.0 + 1e-9


PENDULUM = settings_named("pendulum")


def state(**other: Any) -> StateMessage:
    given: dict[str, Any] = {"corridor": (-0.5, 0.7), "obstacles": (), "field": (), "footprint": (), **other}
    return StateMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=0.0, values=(0.1, 0.2), applied=(0.0,), applied_by="none",
        period=0.01, lockstep=True, goal=(0.0,), **given,
    )  # fmt: skip


def test_a_corridor_is_the_only_barrier_of_a_robot_that_does_not_drive() -> None:
    barriers = PendulumScene(PENDULUM).of(state())
    assert not isinstance(barriers, str)
    (barrier,) = barriers
    assert isinstance(barrier, CorridorBarrier)
    assert (barrier.low, barrier.high, barrier.time) == (-0.5, 0.7, 0.25)


def test_it_is_kept_while_the_scene_stays_and_built_again_when_it_changes() -> None:
    scene = PendulumScene(PENDULUM)
    first = scene.of(state())
    assert scene.of(state()) is first
    other = scene.of(state(corridor=(-0.5, 0.8)))
    assert not isinstance(other, str)
    assert isinstance(other[0], CorridorBarrier)
    assert other[0].high == 0.8


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"corridor": ()}, "got 0 numbers, wanted 2"),
        ({"corridor": (0.1,)}, "wanted 2"),
        ({"corridor": (0.5, 0.1)}, "low < high"),
        ({"footprint": (0.1, 0.3, 0.1)}, "a robot that does not drive"),
        ({"obstacles": ((0.0, 0.0, 1.0),)}, "a robot that does not drive"),
        ({"field": (-1.0, 1.0, -1.0, 1.0)}, "a robot that does not drive"),
    ],
)
def test_an_invalid_scene_is_described_every_time(other: dict[str, Any], message: str) -> None:
    scene = PendulumScene(PENDULUM)
    scene.of(state())
    for _ in range(2):
        answer = scene.of(state(**other))
        assert isinstance(answer, str)
        assert message in answer


def test_a_car_cannot_name_a_corridor_in_place_of_its_obstacles() -> None:
    answer = CarScene(FilterSettings.for_robot("car")).of(replace(state(), values=(0.1, 0.2, 0.0, 1.0)))
    assert isinstance(answer, str)
    assert "a robot with obstacles" in answer


def test_the_settings_of_the_pendulum() -> None:
    assert parse_settings(write_settings(PENDULUM)) == PENDULUM
    assert parse_settings(write_settings(PENDULUM).replace("0.25", "0.4")).barrier("corridor_seconds") == 0.4
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="corridor_seconds"):
            PENDULUM.with_barriers(corridor_seconds=wrong)


def declared(barriers: Any, can_stop: bool = True) -> DeclaredScene:
    robot: Any = SimpleNamespace(
        name="toy",
        can_stop=can_stop,
        barriers=barriers,
        planar_body=lambda *_: None,
        backup=lambda state, _model, _settings: np.array([state[0]]),
    )
    return DeclaredScene(robot, load_model("pendulum"), PENDULUM)


def test_a_declared_robot_has_the_barriers_and_the_backup_that_it_declares() -> None:
    latents: list[Any] = []

    def barriers(_state: Any, _model: Any, latent: Any, _settings: Any) -> list[FunctionBarrier]:
        latents.append(latent)
        return [FunctionBarrier(lambda x: 1.0 - x[0])]

    scene = declared(barriers, can_stop=False)
    scene.learn(np.array([2.0]))
    found = scene.of(state())
    assert not isinstance(found, str)
    assert found.h_floats((0.25, 0.0)) == pytest.approx([0.75])
    assert latents[0].tolist() == [2.0]
    assert scene.backup is not None
    assert scene.backup(np.array([3.0, 0.0])).tolist() == [3.0]
    assert scene.backup(None).tolist() == PENDULUM.resting_action.tolist(), "where it is, no one knows"
    assert (scene.can_stop, declared(barriers).can_stop) == (False, True)
    assert (AbstractScene.can_stop, AbstractScene.quick) == (True, False), "of a robot that says nothing of it"


def test_whatever_a_declared_robot_raises_or_however_many_obstacles_it_has_a_sentence_says_so() -> None:
    scene = declared(lambda *_: [FunctionBarrier(lambda x: 1.0 - x[0])])
    assert not isinstance(scene.of(state(obstacles=((0.0, 0.0, 0.1),) * 64)), str)
    reported = scene.of(state(obstacles=((0.0, 0.0, 0.1),) * 65))
    assert reported == "scene (obstacles: got 65, wanted at most 64; send the nearest)"

    def broken(*_: Any) -> Any:
        raise KeyError("towed")

    place = f"test_towed_reach.py, line {broken.__code__.co_firstlineno + 1}, in broken"
    assert declared(broken).of(state()) == f"scene (barriers of robot 'toy': KeyError: 'towed' ({place}))"


def test_a_robot_s_own_scene_is_taken_and_where_it_has_none_what_it_declares(monkeypatch: pytest.MonkeyPatch) -> None:
    model, own = load_model("pendulum"), scene_of(load_model("pendulum"), PENDULUM)
    assert not isinstance(own, DeclaredScene)
    for scene in (own, None):
        robot = SimpleNamespace(
            scene=lambda *_, scene=scene: scene, can_stop=True, name="any", backup=None, planar_body=lambda *_: None
        )
        monkeypatch.setattr(scenes, "robot_like", lambda _, robot=robot: robot)
        found = scene_of(model, PENDULUM)
        assert found is own if scene is own else isinstance(found, DeclaredScene)
