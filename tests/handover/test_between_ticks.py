"""What one tick hands to the next: poses to late scans, sources and transitions over a change of the model, h to its
curve."""

import dataclasses
from math import hypot
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as some
from tests.messages import stamp, state_of, verdict_of
from tests.safety.node_steps import CAR, SETTINGS, asked, latent_at, state_at, surroundings

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, STATE, SURROUNDINGS, TAKEOVER, VERDICT, ModelMessage, ReceivedMessage, StateMessage
from safedpa.bus import ActionMessage as Action
from safedpa.dynamics import PhysicsModel, Setting, fingerprint, load_model, write_model
from safedpa.effects import effect
from safedpa.perception import PerceptionNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_text
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

PILLARS = ((1.5, 0.9, 0.3), (2.5, -0.8, 0.2))
FIELD = (-3.0, 6.0, -3.0, 3.0)


def off_everything(x: float, y: float) -> float:
    """Distance [m] of a position from the nearest pillar or wall of the scene."""
    walls = (abs(x - FIELD[0]), abs(x - FIELD[1]), abs(y - FIELD[2]), abs(y - FIELD[3]))
    return min(*walls, *(abs(hypot(x - px, y - py) - radius) for px, py, radius in PILLARS))


@pytest.mark.parametrize("latency", [0.05, 0.2, 0.4])
def test_a_scan_is_placed_where_the_robot_was_when_it_was_measured(latency: float) -> None:
    """At 1.5 m/s a scan that is 0.4 s old would be off by 0.6 m."""
    laser = SimulatedSensors((Laser(LaserSettings(latency=latency), 1),))
    robot, node = CarRobot(Scene(0, None, FIELD, PILLARS, (0.0, 0.0, 0.1)), sensor_inputs=laser), PerceptionNode()
    found = list[float]()
    for tick in range(45):
        state = robot.state_message()
        for scan in robot.scans():
            node.hear("r", scan)
        message: Any = node.step("r", state, {})[SURROUNDINGS]
        if state.values[3] > 1.0:
            found += [off_everything(x, y) - radius for x, y, radius in message.points]
        action = Action(epoch=1, tick=tick, robot_time=0.0, publish_time=0.0, values=(1.5, 0.05))
        robot.receive(action)
        robot.advance()
    assert len(found) > 100
    assert max(found) < 0.12, "no disc lies where nothing is"


def next_of(model: PhysicsModel) -> PhysicsModel:
    return model.with_effect(effect("car", "steering_offset"), {"angle": Setting(0.01)})


def offered(model: PhysicsModel, step: str, from_tick: int = 0) -> ModelMessage:
    margin = dataclasses.replace(margin_for(CAR), fingerprint=fingerprint(model), slower={})  # type: ignore[type-var]
    whole = step == "offer"
    return ModelMessage(
        **stamp(0), step=step, change=1, fingerprint=fingerprint(model), replaces=fingerprint(CAR),
        document=write_model(model) if whole else "", margin=margin_text(margin) if whole else "", from_tick=from_tick,
    )  # fmt: skip


def test_sources_that_vanish_are_missed_by_the_next_model_too() -> None:
    corrected = next_of(CAR)
    node = SafetyFilterNode(CAR, SETTINGS, margin_for(CAR), limits=None)

    def verdict(tick: int, model: PhysicsModel, *sources: str) -> Any:
        state = state_at(tick, (0.0, 0.0, 0.0, 0.5), obstacles=(), sources=sources)
        return asked(node, state, latent_at(state, model), seen=surroundings(state))

    verdict(0, CAR, "laser")
    node.hear("r", offered(corrected, "offer"))
    verdict(1, CAR, "laser")
    node.hear("r", offered(corrected, "take", from_tick=3))
    verdict(2, CAR, "laser")
    gone = verdict(3, corrected)
    assert node.model_of("r") == fingerprint(corrected)
    assert (gone.status, "no longer named" in gone.sentence) == ("fallback", True)


ROUGH = CAR.with_effect(effect("car", "rolling_resistance"), {"deceleration": Setting(0.2, free=True)})
FREE, LEARNED = ROUGH, load_model("car_learned")
"""One whose parameters are estimated from tick to tick, one whose latent is encoded from the last 50 transitions."""


def drive(first: int, count: int, deceleration: float) -> list[StateMessage]:
    """States of a car whose target speed steps up and down."""
    latent = ROUGH.latent.copy()
    latent[ROUGH.latent_names.index("rolling_resistance.deceleration")] = deceleration
    values, action, found = np.array([0.0, 0.0, 0.0, 1.0]), np.array([1.0, 0.0]), []
    for tick in range(first, first + count):
        found.append(state_of(*values.tolist(), **stamp(tick), applied=tuple(action.tolist()), lockstep=True))
        action = np.array([1.6 if tick // 20 % 2 == 0 else 0.4, 0.1])
        values = ROUGH.step(values, action, latent)
    return found


def learned(model: PhysicsModel, *parts: list[StateMessage]) -> list[tuple[float, ...]]:
    """The latents of the next model, offered five ticks before the end and in force from the last but two."""
    node, successor, found = AdaptationNode(model), next_of(model), []
    states = [state for part in parts for state in part]
    for state in states[:-5]:
        node.step("r", state, {})
        node.afterwards("r")
    node.hear("r", offered(successor, "offer"))
    for index, state in enumerate(states[-5:]):
        message: Any = node.step("r", state, {})[LATENT]
        answer: Any = node.afterwards("r").get(TAKEOVER)
        assert answer is None or answer.state in ("ready", "taken"), answer
        if index == 0:
            node.hear("r", offered(successor, "take", from_tick=states[-3].tick))
        if message.model == fingerprint(successor):
            found.append(message.values)
    return found


@settings(max_examples=8)
@given(some.sampled_from([FREE, LEARNED]), some.integers(20, 60), some.integers(2, 100), some.integers(8, 30))
def test_transitions_before_a_gap_teach_the_next_model_nothing(model: PhysicsModel, before: int, gap: int, after: int):
    """Before the gap the floor was rough, after it smooth."""
    rough, smooth = drive(0, before, 1.5), drive(before + gap, after, 0.0)
    assert learned(model, rough, smooth) == learned(model, smooth)
    assert len(learned(model, smooth)) == 3


@settings(max_examples=20)
@given(some.lists(some.floats(-2.0, 2.0), min_size=3, max_size=12), some.data())
def test_the_curve_of_h_has_at_each_tick_the_h_of_its_verdict(heights: list[float], data: some.DataObject) -> None:
    """Also where verdicts come with the state of the next tick, or several at once."""
    view = FleetView(display_settings(CAR, FilterSettings.for_robot("car")))
    drawn: dict[float, tuple[float, ...]] = {}
    waiting: list[ReceivedMessage] = []
    for tick, h in enumerate(heights):
        at = stamp(tick)
        state = state_of(0.0, 0.0, 0.0, 1.0, **at, applied=(1.0, 0.0), footprint=(0.1, 0.4, 0.1))
        verdict = verdict_of("passed", **at, action=(1.0, 0.0), nominal=(1.0, 0.0), h_now=h, h_next=h + 10.0)
        for topic, message in ((STATE, state), (VERDICT, verdict)):
            key = f"safedpa/fleet/r1/{topic.name}"
            waiting.append(ReceivedMessage(topic, "r1", message, b"", key, 0.05 * tick + 0.01 * (topic is VERDICT)))
        if tick + 1 == len(heights) or data.draw(some.booleans()):
            frames = view.take(list(waiting), waiting[-1].at)
            waiting.clear()
            for frame in frames:
                curves = [entry for entry in frame.entries if entry.path[-1] == "barrier" and not entry.static]
                drawn.update((frame.at, entry.shape.values) for entry in curves)  # type: ignore[union-attr]
    in_order = [values[0] for _, values in sorted(drawn.items())]
    assert in_order == heights
    times = sorted(drawn)
    np.testing.assert_allclose(np.diff(times), 0.05, atol=1e-6)
    assert all(values[1] == values[0] + 10.0 for values in drawn.values())
