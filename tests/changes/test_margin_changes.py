"""A new model's margin: announced before it is used, never a reason to stop, and no tick without a decision."""

import dataclasses
from typing import Any

import pytest
from tests.messages import latent_of, stamp, state_of

from safedpa.bus import (
    LATENT,
    NOMINAL,
    TAKEOVER,
    VERDICT,
    ModelMessage,
    NominalMessage,
    Request,
    StateMessage,
    TakeoverMessage,
)
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.live.versions import OfferedEffect
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_text
from safedpa.safety.margins.transition import MarginRamp, margin_change, margin_table

CAR = load_model("car")
SETTINGS = settings_named("car")
SHIPPED = margin_for(CAR)
assert SHIPPED is not None
OLD = dataclasses.replace(SHIPPED, epsilon={"obstacle": 0.03, "field": 0.03, "speed": 0.05})
DOCUMENT = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
WIDE = dataclasses.replace(OLD, fingerprint=NEW, epsilon={"obstacle": 0.115, "field": 0.115, "speed": 0.05})
TIGHT, ROOMY = 0.09, 0.5
"""h of the obstacle: enough for a car that stands behind the old margin, 0.03 / 0.35, and for the new one."""


def reach() -> float:
    return 0.40 + 0.12 + SETTINGS.barrier("clearance")


class Standing:
    """A car that stands before an obstacle, its filter, and a nominal action to go on standing."""

    def __init__(self, **loop: Any) -> None:
        self.node = SafetyFilterNode(CAR, SETTINGS, OLD)
        self.tick, self.h, self.latents_of, self.loop = 0, TIGHT, CAR, {"lockstep": True, "latent_age": 0, **loop}
        self.heard: list[Any] = []

    def state(self) -> StateMessage:
        return state_of(
            0.0, 0.0, 0.0, 0.0, **stamp(self.tick), applied_by="filter" if self.tick else "none",
            lockstep=self.loop["lockstep"], goal=(3.0, 0.0), obstacles=((reach() + 0.3 + self.h, 0.0, 0.3),),
            field=(-9.0, 9.0, -9.0, 9.0), footprint=(0.08, 0.40, 0.12),
        )  # fmt: skip

    def turn(self) -> Any:
        state, model = self.state(), self.latents_of
        latent = latent_of(*model.latent.tolist(), tick=self.tick - self.loop["latent_age"], model=fingerprint(model))
        nominal = NominalMessage(**stamp(self.tick), values=(0.0, 0.0), controller="test")
        self.node.prepare("r1", state)
        outputs = dict(self.node.step("r1", state, {LATENT: latent, NOMINAL: nominal}))
        outputs.update(self.node.afterwards("r1"))
        self.tick += 1
        if TAKEOVER in outputs:
            self.heard.append(outputs[TAKEOVER])
        return outputs[VERDICT]

    def offer(self, margin: Any = WIDE) -> None:
        self.node.hear("r1", self._message("offer", document=DOCUMENT, margin=margin_text(margin)))
        self.turn()

    def take(self) -> None:
        self.node.hear("r1", self._message("take", from_tick=self.tick))

    def _message(self, step: str, **more: Any) -> ModelMessage:
        return ModelMessage(**stamp(self.tick), step=step, change=1, fingerprint=NEW, replaces=fingerprint(CAR), **more)


def test_the_change_of_the_margin_is_reported_before_it_is_used() -> None:
    car = Standing()
    car.turn()
    car.offer()
    assert car.heard[-1].state == "ready"
    assert car.heard[-1].expected_effect == (
        "the margin of obstacle goes from 0.03 to 0.115 where h is 0.09: at once it would stop the robot here, so it "
        "follows h, all of it from 0.493 on; the margin of field goes from 0.03 to 0.115 where h is 8.43, at once"
    )


def test_a_wider_margin_does_not_stop_a_robot_where_it_stands_and_comes_with_the_room() -> None:
    car = Standing()
    before = car.turn()
    assert (before.status, before.margin) == ("passed", 0.05)
    car.offer()
    car.take()
    car.latents_of = parse_model(DOCUMENT)
    verdicts = [car.turn() for _ in range(40)]
    assert {verdict.status for verdict in verdicts} == {"passed"}
    assert verdicts[-1].model == NEW
    assert "Not the whole margin for 2.0 s, until h allows: obstacle 0.03 of 0.115." in verdicts[-1].sentence
    car.h = 0.4
    meanwhile = car.turn()
    assert "obstacle 0.07 of 0.115" in meanwhile.sentence
    car.h = TIGHT
    assert car.turn().status == "passed", "and it goes back with h, down to the old one"
    car.h = ROOMY
    after = car.turn()
    assert (after.status, after.margin) == ("passed", 0.115)
    assert "margin" not in after.sentence
    car.h = 0.33
    assert car.turn().margin == 0.115, "what is in force stays"


def test_without_a_margin_before_the_whole_one_is_in_force() -> None:
    """A filter that was restarted knows nothing of the time before."""
    car = Standing()
    car.node = SafetyFilterNode(CAR, SETTINGS, dataclasses.replace(WIDE, fingerprint=fingerprint(CAR)))
    verdict = car.turn()
    assert (verdict.status, verdict.margin) == ("relaxed", 0.115)


@pytest.mark.parametrize("lockstep", [False, True])
def test_no_tick_is_lost_to_a_change(lockstep: bool) -> None:
    """In real time the latent of a tick may be one tick old, and so of the old model at the tick of the change."""
    car = Standing(lockstep=lockstep, latent_age=0 if lockstep else 1)
    car.turn()
    car.offer(dataclasses.replace(OLD, fingerprint=NEW))
    car.take()
    if lockstep:
        car.latents_of = parse_model(DOCUMENT)
    verdicts = [car.turn()]
    car.latents_of = parse_model(DOCUMENT)
    verdicts += [car.turn() for _ in range(3)]
    assert [verdict.status for verdict in verdicts] == ["passed"] * 4
    assert [verdict.model == NEW for verdict in verdicts] == [lockstep, True, True, True]
    assert [answer.state for answer in car.heard] == ["ready", "taken"]


def test_the_old_model_decides_for_a_second_and_no_longer() -> None:
    """As long as a latent that is missing is waited for."""
    car = Standing()
    car.turn()
    car.offer()
    car.take()
    statuses = [car.turn().status for _ in range(25)]
    assert statuses == ["passed"] * 21 + ["fallback"] * 4


def test_a_margin_that_was_widened_by_errors_is_not_held_back() -> None:
    phased = MarginRamp({"a": 0.1}, {"a": 0.3, "b": 0.2}, eta=0.5)
    phased.rise({"a": 0.4, "b": 0.1}, 0.05)
    assert phased.limited({"a": 0.3, "b": 0.2}) == {"a": 0.1, "b": 0.025}
    assert phased.limited({"a": 0.31, "b": 0.2, "c": 1.0}) == {"a": 0.31, "b": 0.025, "c": 1.0}
    assert phased.waiting == ("a", "b")
    phased.rise({"a": 0.9}, 0.05)
    assert phased.limited({"a": 0.3, "b": 0.2}) == {"a": 0.3, "b": 0.2}, "where nothing of a kind is, nothing stops"


@pytest.mark.parametrize("h", [0.0, 0.05, 0.2, 0.21, 0.89, 0.9, 1.0])
@pytest.mark.parametrize("old", [0.0, 0.1, 0.4])
def test_a_robot_that_may_stand_before_a_change_may_stand_after_it(h: float, old: float) -> None:
    eta, new = 0.5, 0.3
    phased = MarginRamp({"a": old}, {"a": new}, eta)
    for room in (0.3 * h, h):
        phased.rise({"a": room}, 0.05)
    value = phased.limited({"a": new})["a"]
    assert min(old, new) <= value <= new
    assert value <= max(min(old, new), eta * h)
    assert (phased.waiting == ()) is (new <= old or h >= 1.5 * new / eta)


def test_command_and_page_report_the_margin_before_it_is_used(changing_node: Any) -> None:
    """With the decision, and in the answer to ``status`` until the next change."""
    changes = changing_node(CAR).changes
    changes.propose(1, {"steering_offset": OfferedEffect("steering_offset", NEW, DOCUMENT, margin_text(WIDE))})
    state = Standing().state()
    assert changes.step(state) is None
    asked = Request(do="accept", effect="steering_offset", model=changes.fingerprint, finding=1, who="test")
    assert changes.answer(asked).ok
    offered = changes.step(dataclasses.replace(state, tick=1))
    about = {**stamp(1), "change": 1, "fingerprint": NEW}
    for service in ("adaptation", "policy", "safety_filter"):
        reported = "the margin of a goes from 0.03 to 0.115" if service == "safety_filter" else ""
        changes.hear(TakeoverMessage(**about, service=service, state="ready", expected_effect=reported))
    take = changes.step(dataclasses.replace(state, tick=2))
    assert (offered.step, take.step) == ("offer", "take")
    assert changes.sentence.endswith("used from tick 7 on; the margin of a goes from 0.03 to 0.115")
    assert changes.fingerprint != NEW, "reported before it is used"


def test_one_calibration_has_one_text_whatever_the_order_of_its_tables() -> None:
    turned = dataclasses.replace(OLD, epsilon=dict(reversed(OLD.epsilon.items())))
    assert margin_text(turned) == margin_text(OLD)
    assert list(turned.epsilon) != list(OLD.epsilon)


@pytest.mark.parametrize(
    ("old", "h", "reported"),
    [
        ({}, 5.0, ["the margin of a goes from 0 to 0.125 where h is 5, at once"]),
        ({"a": 0.2}, 0.01, ["goes from 0.2 to 0.125 where h is 0.01, at once"]),
        ({"a": 0.1}, 0.375, ["goes from 0.1 to 0.125 where h is 0.375, at once"]),
        ({"a": 0.1}, 0.25, ["hardly any room, so it follows h, all of it from 0.375 on"]),
        ({"a": 0.1}, 0.24, ["it would stop the robot here", "all of it from 0.375 on"]),
        ({"a": 0.125}, 0.1, []),
    ],
)
def test_the_sentence_about_a_change_at_its_limits(old: dict[str, float], h: float, reported: list[str]) -> None:
    """With eta = 1/2 a robot may stand from h = 0.25 on, and the margin is in force as a whole from 0.375 on."""
    text = margin_change(old, {"a": 0.125}, {"a": h}, 0.5)
    assert all(phrase in text for phrase in reported)
    assert bool(text) == bool(reported)
    assert margin_change({"a": 0.2}, {"a": 0.3}, {}, 0.5) == "the margin of a goes from 0.2 to 0.3"
    table = margin_table(old, {"a": 0.125}, {"a": h}, 0.5)
    assert bool(table) == bool(reported)
    if reported:
        kind, now, then, h_now, effect = table.split("\n")[1].split(" | ")
        assert f"the margin of {kind} goes from {now} to {then} where h is {h_now}" in text
        assert text.endswith(effect)


def test_the_table_of_margins_begins_with_the_kind_that_would_stop_the_robot() -> None:
    old, new, h = {"a": 0.1, "b": 0.1, "c": 0.1, "d": 0.1}, {"a": 0.05, "b": 2.0, "c": 0.3, "d": 0.1}, {"a": 1, "b": 1}
    assert margin_table(old, new, h, 0.5).split("\n") == [
        "margin of | now | then | h now | takes effect",
        "b | 0.1 | 2 | 1 | at once it would stop the robot here, so it follows h, all of it from 6 on",
        "a | 0.1 | 0.05 | 1 | at once",
        "c | 0.1 | 0.3 | - | once such a barrier is near",
    ]


def test_a_margin_rises_from_nothing_and_is_whole_at_its_limit() -> None:
    phased = MarginRamp({}, {"a": 0.125}, 0.5)
    assert phased.waiting == ("a",)
    assert phased.limited({"a": 0.125, "b": 0.3}) == {"a": 0.0, "b": 0.3}
    phased.rise({"a": 0.374}, 0.05)
    assert phased.limited({"a": 0.125}) == {"a": pytest.approx(0.0935)}
    phased.rise({"a": 0.375}, 0.05)
    assert phased.waiting == ()
    assert phased.limited({"a": 0.125}) == {"a": 0.125}
    assert MarginRamp({"a": 0.125}, {"a": 0.125}, 0.5).waiting == ()
