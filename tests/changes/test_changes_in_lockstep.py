"""The real services change their model while a simulated car drives, in one process and bit for bit."""

import dataclasses
import itertools
from typing import Any

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, AbstractNode, Inputs, LatentMessage, Outputs, StateMessage
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.live.versions import OfferedEffect
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_from_text, margin_text
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

OFFSET = '\n[[effects]]\nname = "steering_offset"\nangle = { value = 0.01, free = true }\n'
TICKS = 160


class Ear(AbstractNode):
    """Hears the latents."""

    name = "ear"
    inputs = (LATENT,)
    outputs = ()
    share = 0.95

    def __init__(self) -> None:
        self.latents: list[LatentMessage] = []

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        latent = inputs[LATENT]
        assert isinstance(latent, LatentMessage)
        self.latents.append(latent)
        return {}


def offset_candidate(name: str) -> OfferedEffect:
    """The model with a steering offset, and the shipped margin under its name."""
    model = load_model(name)
    changed = parse_model(write_model(model) + OFFSET, getattr(_source(model), "parent", None))
    margin = margin_for(model)
    assert margin is not None
    own = margin_text(dataclasses.replace(margin, fingerprint=fingerprint(changed), date="2026-01-01"))
    return OfferedEffect("steering_offset", fingerprint(changed), write_model(changed), own, "r1 ticks 0 to 40")


def _source(model: Any) -> Any:
    weights = getattr(model.base, "weights", None)
    return None if weights is None else weights.source


class Drive:
    """A car with a chair; something may be asked at a tick."""

    def __init__(self, changing_node: Any, name: str = "car", at: int = -1, do: Any = None, ticks: int = TICKS) -> None:
        model = load_model(name)
        self.changing = changing_node(model)
        self.ear = Ear()
        filtering = SafetyFilterNode(model, settings_named("car"), margin_for(model))
        self.services = (AdaptationNode(model), PolicyNode(model), filtering)
        self.robot = CarRobot(Scene.random(3, "chair"), 0.05)
        self.ticks: list[Tick] = []
        for tick in drive(self.robot, [*self.services, self.changing, self.ear], ticks):
            self.ticks.append(tick)
            if tick.state.tick == at:
                do(self.changing.changes)

    @property
    def statuses(self) -> set[str]:
        return {tick.verdict.status for tick in self.ticks}


def accept(candidate: OfferedEffect) -> Any:
    def do(changes: Any) -> None:
        from safedpa.bus import Request

        changes.propose(1, {candidate.effect: candidate})
        request = Request(do="accept", effect=candidate.effect, model=changes.fingerprint, finding=1, who="test")
        assert changes.answer(request).ok

    return do


@pytest.fixture(scope="module")
def untouched(changing_node: Any) -> Drive:
    return Drive(changing_node)


@pytest.fixture(scope="module", params=["car", "car_learned"])
def changed(changing_node: Any, request: pytest.FixtureRequest) -> tuple[Drive, OfferedEffect]:
    candidate = offset_candidate(request.param)
    return Drive(changing_node, request.param, 40, accept(candidate)), candidate


def test_all_services_change_at_the_same_tick_and_no_tick_lacks_a_decision(changed: tuple[Drive, OfferedEffect]):
    run, candidate = changed
    offer, take = run.changing.spoken
    assert (offer.step, take.step) == ("offer", "take")
    assert {answer.state for answer in run.changing.heard} == {"ready", "taken"}
    assert {answer.tick for answer in run.changing.heard if answer.state == "taken"} == {take.from_tick}
    assert len([answer for answer in run.changing.heard if answer.state == "taken"]) == 3
    models = {latent.tick: latent.model for latent in run.ear.latents}
    assert all((models[tick] == candidate.fingerprint) is (tick >= take.from_tick) for tick in range(TICKS))
    assert "fallback" not in run.statuses
    assert run.robot.collisions == []
    assert {service.model_of("r1") for service in run.services} == {candidate.fingerprint}


def test_the_filter_uses_the_margin_of_the_new_model_from_then_on(changed: tuple[Drive, OfferedEffect]) -> None:
    run, _ = changed
    agreed = run.services[2].agreed("r1")
    assert margin_from_text(agreed.margin).date == "2026-01-01"


def test_the_new_latent_begins_where_the_file_and_the_last_seconds_put_it(changed: tuple[Drive, OfferedEffect]) -> None:
    run, _ = changed
    take = run.changing.spoken[1].from_tick
    before, after = run.ear.latents[take - 1], run.ear.latents[take]
    assert len(after.values) == len(before.values) + 1
    if len(before.values) > 2:  # learned: the history is known, so the networks' latent goes on
        gaps = [abs(one - other) for one, other in zip(after.values, before.values, strict=False)]
        steps = [
            max(abs(a - b) for a, b in zip(run.ear.latents[k].values, run.ear.latents[k - 1].values, strict=False))
            for k in range(take - 5, take)
        ]
        assert max(gaps) <= 3.0 * max(steps) + 1e-9
    else:
        assert abs(after.values[-1] - 0.01) < 0.05


def test_a_change_repeats_bit_for_bit(changing_node: Any, untouched: Drive) -> None:
    runs = [Drive(changing_node, "car", 40, accept(offset_candidate("car"))) for _ in range(2)]
    assert runs[0].robot.trajectory_hash == runs[1].robot.trajectory_hash
    assert runs[0].robot.trajectory_hash != untouched.robot.trajectory_hash


def test_an_offer_that_is_dropped_changes_nothing(changing_node: Any, untouched: Drive) -> None:
    """Not one bit of the drive: preparing a model has no effect on the one in force."""
    candidate = offset_candidate("car")
    broken = dataclasses.replace(candidate, margin=candidate.margin.replace(candidate.fingerprint, "0123456789ab"))
    run = Drive(changing_node, "car", 40, accept(broken))
    assert [message.step for message in run.changing.spoken] == ["offer", "drop"]
    assert "safety_filter refused it: margin: calibrated for model 0123456789ab" in run.changing.changes.sentence
    assert run.robot.trajectory_hash == untouched.robot.trajectory_hash
    assert {service.model_of("r1") for service in run.services} == {fingerprint(load_model("car"))}


def longest_stand(run: Drive) -> float:
    """s without a speed of 2 cm/s."""
    stationary_for = (sum(1 for _ in group) for still, group in itertools.groupby(run.ticks, key=_stationary) if still)
    return 0.05 * max(stationary_for, default=0)


def _stationary(tick: Tick) -> bool:
    return abs(tick.state.values[3]) < 0.02


def test_a_car_drives_on_behind_a_margin_that_its_place_does_not_allow(changing_node: Any) -> None:
    """Where h is least: all of it at once, or as much as h ever allowed, made it stand for good."""
    narrow = offset_candidate("car")
    margin = margin_from_text(narrow.margin)
    wide = dataclasses.replace(margin, epsilon=dict.fromkeys(margin.epsilon, 0.115))
    reference = Drive(changing_node, ticks=250)
    tightest = min(reference.ticks[40:], key=lambda tick: tick.verdict.h_now).state.tick
    run = Drive(changing_node, "car", tightest - 7, accept(dataclasses.replace(narrow, margin=margin_text(wide))), 500)
    take = run.changing.spoken[1].from_tick
    before = run.ticks[take - 1].verdict
    assert 0.0 < before.h_now < 0.115 / 0.35
    assert "at once it would stop the robot here" in run.changing.changes.sentence
    assert longest_stand(run) < 4.0
    after = [tick.verdict.status for tick in run.ticks[take:]]
    assert after.count("relaxed") < 0.05 * len(after)
    assert run.robot.collisions == []
    held = [tick.verdict for tick in run.ticks[take:] if "Not the whole margin" in tick.verdict.sentence]
    assert held
    assert all(verdict.margin >= before.margin for verdict in held)
