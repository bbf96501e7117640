"""Two cars that see each other by their lasers alone keep from each other; without the filter they do not."""

from __future__ import annotations

from functools import cache
from math import pi

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import SURROUNDINGS, AbstractNode, SurroundingsMessage
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.counter_braking import STANDS
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import margin_for, settings_named
from safedpa_lab.experiments.sensing_peers import NoFilter
from safedpa_sim.closed_loop import drive_together
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene
from safedpa_sim.robots.shared_field import SharedField
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.senses import Senses

FIELD = (-4.0, 4.0, -4.0, 4.0)
SETTINGS = PerceptionSettings(fastest=2.0, coming=2.0, slimmest=0.12)


@cache
def model() -> PhysicsModel:
    return load_model("car")


def facing(apart: float) -> SharedField:
    """Each has its goal behind the other's back."""
    half = apart / 2
    scenes = (
        Scene(1, None, FIELD, (), (-half, 0.0, 0.0), ((3.2, 0.0), (-3.2, 0.0))),
        Scene(2, None, FIELD, (), (half, 0.03, pi), ((-3.2, 0.0), (3.2, 0.0))),
    )
    return SharedField([CarRobot(one, senses=Senses((Laser(LaserSettings(), one.seed),))) for one in scenes])


def nodes(guard: AbstractNode) -> list[AbstractNode]:
    return [AdaptationNode(model()), PerceptionNode(SETTINGS), PolicyNode(model(), "goal_seeker"), guard]


def met(apart: float, *, filtered: bool, seconds: float = 4.0) -> SharedField:
    field = facing(apart)
    guards = [
        SafetyFilterNode(model(), settings_named("car"), margin_for(model())) if filtered else NoFilter() for _ in "12"
    ]
    for _ in drive_together(field, [nodes(guard) for guard in guards], round(seconds / 0.05)):
        pass
    return field


@pytest.mark.parametrize("apart", [2.5, 5.0])
def test_head_on_they_touch_without_the_filter_and_with_it_do_not(apart: float) -> None:
    (touch,) = met(apart, filtered=False).touches[:1]
    assert min(touch.speeds) > 1.0
    kept = met(apart, filtered=True)
    assert [touch for touch in kept.touches if max(touch.speeds) >= STANDS] == []
    assert all(abs(robot.values[0]) < apart / 2 + 0.5 for robot in kept.robots)


def test_each_is_a_mover_to_the_other() -> None:
    field, heard = facing(4.0), list[SurroundingsMessage]()

    class Hears(NoFilter):
        senses = (SURROUNDINGS,)

        def step(self, robot, state, inputs):  # type: ignore[no-untyped-def]
            told = inputs.get(SURROUNDINGS)
            if isinstance(told, SurroundingsMessage):
                heard.append(told)
            return super().step(robot, state, inputs)

    for _ in drive_together(field, [nodes(Hears()), nodes(NoFilter())], 16):
        pass
    other = field.robots[1].values
    nearest = min(abs(x - (other[0] - 0.4)) + abs(y - other[1]) for x, y, *_ in heard[-1].movers)
    assert nearest < 0.4
