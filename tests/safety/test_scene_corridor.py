"""What the filter makes of a corridor in a state message."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa.robots.car.car_scene import CarScene
from safedpa.robots.pendulum.pendulum_scene import PendulumScene
from safedpa.safety import CorridorBarrier, FilterSettings, FunctionBarrier, scenes
from safedpa.safety.scene import AbstractScene, DeclaredScene
from safedpa.safety.scenes import scene_of
from safedpa.safety.settings import parse_settings, write_settings
from safedpa.safety.shipped import settings_named

SETTINGS = settings_named("pendulum")


def state(**other: Any) -> StateMessage:
    given: dict[str, Any] = {"corridor": (-0.5, 0.7), "obstacles": (), "field": (), "footprint": (), **other}
    return StateMessage(
        epoch=1,
        tick=0,
        robot_time=0.0,
        publish_time=0.0,
        values=(0.1, 0.2),
        applied=(0.0,),
        applied_by="none",
        period=0.01,
        lockstep=True,
        goal=(0.0,),
        **given,
    )


def test_a_corridor_is_the_only_barrier_of_a_robot_that_does_not_drive() -> None:
    barriers = PendulumScene(SETTINGS).of(state())
    assert not isinstance(barriers, str)
    (barrier,) = barriers
    assert isinstance(barrier, CorridorBarrier)
    assert (barrier.low, barrier.high, barrier.time) == (-0.5, 0.7, 0.25)


def test_it_is_kept_while_the_scene_stays_and_built_again_when_it_changes() -> None:
    scene = PendulumScene(SETTINGS)
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
    scene = PendulumScene(SETTINGS)
    scene.of(state())
    for _ in range(2):
        answer = scene.of(state(**other))
        assert isinstance(answer, str)
        assert message in answer


def test_a_car_cannot_name_a_corridor_in_place_of_its_obstacles() -> None:
    answer = CarScene(FilterSettings()).of(replace(state(), values=(0.1, 0.2, 0.0, 1.0)))
    assert isinstance(answer, str)
    assert "a robot that drives between obstacles" in answer


def test_the_settings_of_the_pendulum() -> None:
    assert SETTINGS.action_low == (-10.0,)
    assert SETTINGS.action_high == (10.0,)
    assert SETTINGS.eta == 0.5
    assert SETTINGS.epsilon == {"corridor": 0.02}
    assert SETTINGS.resting_action.tolist() == [0.0]
    assert parse_settings(write_settings(SETTINGS)) == SETTINGS
    assert parse_settings(write_settings(SETTINGS).replace("0.25", "0.4")).barrier("corridor_seconds") == 0.4
    for wrong in (0.0, -1.0, float("nan")):
        with pytest.raises(InputError, match="corridor_seconds"):
            SETTINGS.with_barriers(corridor_seconds=wrong)


def declared(barriers: Any, stands: bool = True) -> DeclaredScene:
    robot: Any = SimpleNamespace(
        name="toy", stands=stands, barriers=barriers, backup=lambda state, _model, _settings: np.array([state[0]])
    )
    return DeclaredScene(robot, load_model("pendulum"), SETTINGS)


def test_a_declared_robot_has_the_barriers_and_the_backup_that_it_declares() -> None:
    latents: list[Any] = []

    def barriers(_state: Any, _model: Any, latent: Any, _settings: Any) -> list[FunctionBarrier]:
        latents.append(latent)
        return [FunctionBarrier(lambda x: 1.0 - x[0])]

    scene = declared(barriers, stands=False)
    scene.learn(np.array([2.0]))
    found = scene.of(state())
    assert not isinstance(found, str)
    assert found.heights((0.25, 0.0)) == pytest.approx([0.75])
    assert latents[0].tolist() == [2.0]
    assert scene.backup is not None
    assert scene.backup(np.array([3.0, 0.0])).tolist() == [3.0]
    assert scene.backup(None).tolist() == SETTINGS.resting_action.tolist(), "where it is, nobody knows"
    assert (scene.stands, declared(barriers).stands) == (False, True)
    assert (AbstractScene.stands, AbstractScene.quick) == (True, False), "of a robot that says nothing of it"


def test_a_declared_robot_among_too_many_obstacles_has_no_scene() -> None:
    scene = declared(lambda *_: [FunctionBarrier(lambda x: 1.0 - x[0])])
    assert not isinstance(scene.of(state(obstacles=((0.0, 0.0, 0.1),) * 64)), str)
    told = scene.of(state(obstacles=((0.0, 0.0, 0.1),) * 65))
    assert told == "scene (obstacles: got 65, wanted at most 64; send the nearest)"


def test_whatever_a_declared_robot_raises_is_a_sentence() -> None:
    def broken(*_: Any) -> Any:
        raise KeyError("towed")

    assert declared(broken).of(state()) == "scene (barriers of robot 'toy': KeyError: 'towed')"


def test_a_robot_s_own_scene_is_taken_and_where_it_has_none_what_it_declares(monkeypatch: pytest.MonkeyPatch) -> None:
    model, own = load_model("pendulum"), scene_of(load_model("pendulum"), SETTINGS)
    assert not isinstance(own, DeclaredScene)
    for scene in (own, None):
        robot = SimpleNamespace(scene=lambda *_, scene=scene: scene, stands=True, name="any", backup=None)
        monkeypatch.setattr(scenes, "robot_like", lambda _, robot=robot: robot)
        found = scene_of(model, SETTINGS)
        assert found is own if scene is own else isinstance(found, DeclaredScene)
