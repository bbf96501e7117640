"""Every service checks what it is offered: what does not fit is refused with a reason, and the robot drives on."""

import dataclasses
import json
from typing import Any

import pytest
from tests.messages import latent_of, stamp

from safedpa.adaptation import AdaptationNode
from safedpa.bus import LATENT, NOMINAL, TAKEOVER, Answer, ModelMessage, NominalMessage
from safedpa.bus.messages.codec import decode, encode
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.dynamics.model_offer import offered_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa.safety.margins.calibration import margin_from_text, margin_text

CAR = load_model("car")
MARGIN = margin_for(CAR)
assert MARGIN is not None
DOCUMENT = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
GOOD_MARGIN = dataclasses.replace(MARGIN, fingerprint=NEW, slower={})
"""Of one period, whose kinds a test may take away."""
NODES = ("adaptation", "policy", "safety_filter")


def node_named(name: str, model: Any = CAR) -> Any:
    if name == "adaptation":
        return AdaptationNode(model)
    if name == "policy":
        return PolicyNode(model)
    return SafetyFilterNode(model, settings_named("car"), margin_for(model))


def offer(document: str = DOCUMENT, name: str = NEW, margin: str | None = None, change: int = 1) -> ModelMessage:
    message = ModelMessage(
        **stamp(0), step="offer", change=change, fingerprint=name, replaces=fingerprint(CAR), document=document,
        margin=margin_text(GOOD_MARGIN) if margin is None else margin,
    )  # fmt: skip
    return decode(ModelMessage, encode(message))


def decision(step: str, from_tick: int = 0, change: int = 1, epoch: int = 1) -> ModelMessage:
    return dataclasses.replace(
        offer(change=change), step=step, document="", margin="", from_tick=from_tick, epoch=epoch
    )


class Ticking:
    """One node, tick after tick, with a nominal action and a latent of the model that ``latents_of`` names."""

    def __init__(self, node: Any, state_of: Any) -> None:
        self.node, self.state_of, self.tick = node, state_of, 0
        self.values = lambda _tick: (0.0, 0.0, 0.0, 0.0)
        self.latents_of, self.latent = fingerprint(CAR), tuple(CAR.latent.tolist())

    def turn(self, epoch: int = 1) -> Any:
        state = dataclasses.replace(self.state_of(self.tick, epoch), values=self.values(self.tick))
        now = stamp(self.tick, epoch=epoch)
        latent = latent_of(*self.latent, **now, model=self.latents_of, deviations=self.latent)
        inputs = {LATENT: latent, NOMINAL: NominalMessage(**now, values=(0.5, 0.0), controller="test")}
        outputs = dict(self.node.step("r1", state, {topic: inputs[topic] for topic in self.node.inputs}))
        outputs.update(self.node.afterwards("r1"))
        self.tick += 1
        return outputs

    def answer(self) -> tuple[str, str]:
        takeover = self.turn()[TAKEOVER]
        return takeover.state, takeover.reason


@pytest.fixture(params=NODES)
def ticking(request: pytest.FixtureRequest, driving_state: Any) -> Ticking:
    ticking = Ticking(node_named(request.param), driving_state)
    ticking.turn()
    return ticking


BROKEN_DOCUMENTS = {
    "not TOML": ("{{{", "not TOML"),
    "empty": ("", "format: missing"),
    "another robot": (write_model(load_model("dfki_pendulum")), "robot: got pendulum, the model in force has car"),
    "another period": (DOCUMENT.replace("period = 0.05", "period = 0.1"), "period: got 0.1"),
    "an unknown effect": (DOCUMENT.replace("steering_offset", "steering_offsett"), "steering_offset"),
    "a number that is none": (DOCUMENT.replace("angle = 0.01", "angle = nan"), "steering_offset.angle"),
    "another drive": (DOCUMENT.replace("speed_servo", "throttle"), "base"),
    "deeply nested": ("x = " + "[" * 50000, ""),
    "learned networks": (write_model(load_model("car_learned")), "networks"),
}


@pytest.mark.parametrize("case", BROKEN_DOCUMENTS)
def test_a_broken_document_is_refused_with_the_reason(ticking: Ticking, case: str) -> None:
    document, reason = BROKEN_DOCUMENTS[case]
    try:
        own = fingerprint(parse_model(document))
    except (InputError, RecursionError):
        own = NEW
    ticking.node.hear("r1", offer(document, own, ""))
    state, reported = ticking.answer()
    assert state == "refused"
    assert reason in reported
    assert "\n" not in reported
    ticking.node.hear("r1", decision("take"))
    assert ticking.answer()[0] == "refused"
    assert ticking.node.model_of("r1") == fingerprint(CAR)


def test_a_document_with_another_fingerprint_is_refused(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer(name="0123456789ab"))
    assert ticking.answer() == ("refused", f"fingerprint: the document has {NEW}, the offer says 0123456789ab")


@pytest.mark.parametrize(("document_of", "current"), [("car_fix", "car_learned"), ("car", "car_learned")])
def test_networks_do_not_travel(document_of: str, current: str) -> None:
    """Other weights lie in the same folder, and could be loaded; but this change was not checked for them."""
    model = load_model(document_of)
    with pytest.raises(InputError, match=r"networks\.digest: got .*, the model in force has"):
        offered_model(offer(write_model(model), fingerprint(model)), load_model(current))


def _altered(**changes: Any) -> str:
    return json.dumps({**json.loads(margin_text(GOOD_MARGIN)), **changes})


BROKEN_MARGINS = {
    "none": ("", "missing, but the active model"),
    "no JSON": ("{", "margin: "),
    "a list": ("[1]", "margin: "),
    "another key": (_altered(more=1), "margin: "),
    "of another model": (_altered(fingerprint="0123456789ab"), "calibrated for model 0123456789ab"),
    "not a number": (_altered(epsilon={"obstacle": float("nan")}), "epsilon.obstacle"),
    "below zero": (_altered(epsilon={"obstacle": -1.0}), "epsilon.obstacle"),
    "less coverage": (_altered(coverage=0.5), "covers 0.5 of the steps, the active one 0.99"),
    "a kind missing": (_altered(epsilon={"speed": 0.1}), "missing for field, obstacle"),
    "deeply nested": ("[" * 100000, ""),
}


@pytest.mark.parametrize("case", BROKEN_MARGINS)
def test_the_filter_refuses_a_margin_that_promises_less_or_nothing(driving_state: Any, case: str) -> None:
    ticking = Ticking(node_named("safety_filter"), driving_state)
    ticking.turn()
    margin, reason = BROKEN_MARGINS[case]
    ticking.node.hear("r1", offer(margin=margin))
    state, reported = ticking.answer()
    assert state == "refused"
    assert reason in reported


def test_a_margin_survives_the_bus() -> None:
    assert margin_from_text(margin_text(GOOD_MARGIN)) == GOOD_MARGIN


def test_a_good_offer_is_used_from_the_named_tick_and_never_before(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer())
    assert ticking.answer() == ("ready", "")
    ticking.node.hear("r1", decision("take", from_tick=5))
    models = []
    while ticking.tick < 8:
        takeover = ticking.turn().get(TAKEOVER)
        models.append((ticking.tick - 1, ticking.node.model_of("r1"), takeover and takeover.state))
    assert models == [
        (tick, NEW if tick >= 5 else fingerprint(CAR), "taken" if tick == 5 else None) for tick in range(2, 8)
    ]
    assert ticking.node.model_of("other") == fingerprint(CAR), "one robot's change is no other's"


def test_a_dropped_offer_cannot_be_taken(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer())
    ticking.turn()
    ticking.node.hear("r1", decision("drop"))
    ticking.node.hear("r1", decision("take"))
    assert ticking.answer() == ("refused", "this process did not receive the offer")
    assert ticking.node.model_of("r1") == fingerprint(CAR)


@pytest.mark.parametrize("prepared", [False, True])
def test_a_drop_of_another_change_leaves_the_offer_as_it_is(ticking: Ticking, prepared: bool) -> None:
    ticking.node.hear("r1", offer())
    if prepared:
        assert ticking.answer() == ("ready", "")
    ticking.node.hear("r1", decision("drop", change=2))
    if not prepared:
        assert ticking.answer() == ("ready", "")
    ticking.node.hear("r1", decision("take"))
    assert ticking.answer() == ("taken", "")
    assert ticking.node.model_of("r1") == NEW


def _outputs(ticking: Ticking) -> dict[Any, Any]:
    """Outputs of one turn, without publish and computation times."""
    unlike = {"publish_time": 0.0, "microseconds": 0.0}
    return {
        topic: dataclasses.replace(message, **{name: 0.0 for name in unlike if hasattr(message, name)})
        for topic, message in ticking.turn().items()
        if topic is not TAKEOVER
    }


@pytest.mark.parametrize("name", NODES)
def test_a_repair_of_others_disturbs_no_service_that_has_the_model_already(driving_state: Any, name: str) -> None:
    """What it learned of an accelerating car goes on: its outputs are those of a service that heard of no repair."""
    repaired, other, restarted = (Ticking(node_named(name), driving_state) for _ in range(3))
    for ticking in (repaired, other, restarted):
        ticking.values = lambda tick: (0.002 * tick**2, 0.0, 0.0, 0.08 * tick)
    for _ in range(20):
        assert _outputs(repaired) == _outputs(other)
    repaired.node.hear("r1", offer(write_model(CAR), fingerprint(CAR), ""))
    assert repaired.answer() == ("ready", "")
    repaired.node.hear("r1", dataclasses.replace(decision("take"), fingerprint=fingerprint(CAR)))
    assert repaired.answer() == ("taken", "")
    for _ in range(2):
        other.turn()
    assert [_outputs(repaired) for _ in range(5)] == [_outputs(other) for _ in range(5)]
    if name == "adaptation":
        restarted.tick = repaired.tick
        assert _outputs(repaired) != _outputs(restarted), "there is something to forget"


def test_a_decision_about_another_change_is_none(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer())
    ticking.turn()
    ticking.node.hear("r1", decision("take", change=2))
    assert ticking.answer()[0] == "refused"
    ticking.turn()
    assert ticking.node.model_of("r1") == fingerprint(CAR)


def test_a_drop_after_the_decision_is_too_late(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer())
    ticking.turn()
    ticking.node.hear("r1", decision("take", from_tick=4))
    ticking.node.hear("r1", decision("drop"))
    ticking.node.hear("r1", offer())
    assert ticking.answer() == ("ready", ""), "offered twice, answered twice"
    for _ in range(4):
        ticking.turn()
    assert ticking.node.model_of("r1") == NEW


def test_a_robot_that_left_and_returns_has_the_model_that_it_had(ticking: Ticking) -> None:
    ticking.node.hear("r1", offer())
    ticking.turn()
    ticking.node.hear("r1", decision("take"))
    ticking.turn()
    ticking.node.forget("r1")
    ticking.turn(epoch=2)
    assert ticking.node.model_of("r1") == NEW


@pytest.mark.parametrize("name", NODES)
def test_a_service_that_was_restarted_begins_with_what_is_in_force(driving_state: Any, name: str) -> None:
    ticking = Ticking(node_named(name), driving_state)
    status = Answer(ok=True, sentence="", change=4, fingerprint=NEW, document=DOCUMENT, margin=margin_text(GOOD_MARGIN))
    ticking.node.adopt_model("r1", status)
    ticking.latents_of, ticking.latent = NEW, tuple(parse_model(DOCUMENT).latent.tolist())
    ticking.turn()
    assert ticking.node.model_of("r1") == NEW


def test_services_report_the_agreed_model_to_each_other(ticking: Ticking) -> None:
    assert ticking.node.agreed("r1") is None, "no one agreed on the model of its own options"
    ticking.node.hear("r1", offer())
    ticking.turn()
    assert ticking.node.agreed("r1") is None, "an offer is no agreement"
    ticking.node.hear("r1", decision("take"))
    ticking.turn()
    reported = ticking.node.agreed("r1")
    assert (reported.ok, reported.change, reported.fingerprint, reported.document) == (True, 1, NEW, DOCUMENT)
    other = Ticking(node_named(ticking.node.name), ticking.state_of)
    other.node.adopt_model("r1", reported)
    assert other.node.model_of("r1") == NEW
    other.node.hear("r1", decision("take"))
    assert other.answer()[0] == "taken", "and knows which change it was"


@pytest.mark.parametrize("name", NODES)
def test_a_service_that_was_restarted_between_decision_and_change_does_both(driving_state: Any, name: str) -> None:
    ticking = Ticking(node_named(name), driving_state)
    ticking.node.adopt_model("r1", _pending("take", from_tick=3))
    models = []
    for _ in range(5):
        ticking.turn()
        models.append(ticking.node.model_of("r1"))
    assert models == [fingerprint(CAR)] * 3 + [NEW] * 2


def _pending(stage: str, from_tick: int = 0) -> Answer:
    return Answer(
        ok=True, sentence="", change=1, fingerprint=fingerprint(CAR), document=write_model(CAR), pending=stage,
        pending_fingerprint=NEW, pending_document=DOCUMENT, pending_margin=margin_text(GOOD_MARGIN), epoch=1,
        from_tick=from_tick,
    )  # fmt: skip


@pytest.mark.parametrize("name", NODES)
def test_a_service_that_was_restarted_amid_an_offer_answers_it(driving_state: Any, name: str) -> None:
    ticking = Ticking(node_named(name), driving_state)
    ticking.node.adopt_model("r1", _pending("offer"))
    assert ticking.answer() == ("ready", "")


@pytest.mark.parametrize("name", NODES)
@pytest.mark.parametrize(
    "status",
    [
        None,
        Answer(ok=False, sentence="refused: robot 'r1' is not known"),
        Answer(ok=True, sentence="", fingerprint="0123456789ab", document="{{{"),
        Answer(ok=True, sentence="", fingerprint="0123456789ab"),
    ],
)
def test_without_a_usable_answer_it_begins_with_its_own_model(driving_state: Any, name: str, status: Any) -> None:
    ticking = Ticking(node_named(name), driving_state)
    ticking.node.adopt_model("r1", status)
    ticking.turn()
    assert ticking.node.model_of("r1") == fingerprint(CAR)


def test_the_filter_falls_back_while_the_latent_is_of_another_model(driving_state: Any) -> None:
    """Of one that it had in force a second ago it takes the latent with that model, of no other."""
    ticking = Ticking(node_named("safety_filter"), driving_state)
    before = ticking.turn()
    ticking.node.hear("r1", offer())
    ticking.turn()
    ticking.node.hear("r1", decision("take"))
    changing = ticking.turn()
    ticking.latents_of = "0123456789ab"
    during = ticking.turn()
    ticking.latents_of = NEW
    after = ticking.turn()
    turns = (before, changing, during, after)
    verdicts = [next(m for t, m in outputs.items() if t.name == "verdict") for outputs in turns]
    assert [verdict.status == "fallback" for verdict in verdicts] == [False, False, True, False]
    assert [verdict.model == NEW for verdict in verdicts] == [False, False, True, True]
    assert f"the filter has {NEW}" in verdicts[2].sentence


def test_a_users_effect_that_fails_is_refused_not_fatal(ticking: Ticking, monkeypatch: pytest.MonkeyPatch) -> None:
    from safedpa.dynamics import model_offer

    def fails(text: str, folder: Any) -> Any:
        raise ZeroDivisionError("planted in a user's effect")

    monkeypatch.setattr(model_offer, "parse_model", fails)
    ticking.node.hear("r1", offer())
    assert ticking.answer() == ("refused", "planted in a user's effect")


def test_a_model_with_which_the_filter_cannot_decide_is_refused(driving_state: Any, monkeypatch: pytest.MonkeyPatch):
    from safedpa.safety.filter import SafetyFilter

    decide, first = SafetyFilter.decide, list[SafetyFilter]()

    def planted(self: SafetyFilter, *arguments: Any, **more: Any) -> Any:
        first.append(self)
        return decide(self, *arguments, **(more if self is first[0] else {**more, "stale": ["planted"]}))

    monkeypatch.setattr(SafetyFilter, "decide", planted)
    ticking = Ticking(node_named("safety_filter"), driving_state)
    ticking.turn()
    ticking.node.hear("r1", offer())
    state, reason = ticking.answer()
    assert state == "refused"
    assert "the filter cannot decide with it" in reason


class Tried:
    """What came of an offer that was tried apart."""

    def __init__(self, **outcome: str) -> None:
        self._outcome = outcome

    def outcome(self, *, wait: bool) -> dict[str, str]:
        del wait
        return self._outcome


def test_an_offer_that_failed_its_trial_is_refused_with_the_reason(ticking: Ticking) -> None:
    ticking.node.use_sandbox(lambda *_: Tried(problem="it ends in a crash"))
    ticking.node.hear("r1", offer())
    assert ticking.answer() == ("refused", "it ends in a crash")
    ticking.node.hear("r1", decision("take", from_tick=ticking.tick + 1))
    assert ticking.answer()[0] == "refused"


def test_an_offer_that_passed_its_trial_is_ready(ticking: Ticking) -> None:
    ticking.node.use_sandbox(lambda *_: Tried(problem=""))
    ticking.node.hear("r1", offer())
    assert ticking.answer()[0] == "ready"


def test_a_robot_whose_step_failed_while_a_model_was_offered_changes_at_the_named_tick_all_the_same(ticking: Ticking):
    """Nothing is remembered of it then, neither an estimate of the old model nor one of the new one."""
    ticking.node.hear("r1", offer())
    assert ticking.answer() == ("ready", "")
    ticking.node.rescue("r1", ticking.state_of(ticking.tick, 1), "planted")
    assert TAKEOVER not in ticking.turn()
    ticking.node.hear("r1", decision("take", from_tick=ticking.tick + 1))
    ticking.turn()
    ticking.node.rescue("r1", ticking.state_of(ticking.tick, 1), "planted")
    assert ticking.answer() == ("taken", "")
    ticking.latents_of, ticking.latent = NEW, tuple(parse_model(DOCUMENT).latent.tolist())
    ticking.turn()
    assert ticking.node.model_of("r1") == NEW
