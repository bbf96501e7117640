"""What a node is asked before it gets an offered model: an answer, and no more of the processor than fits."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from tests.services.test_demo_story import STAMP, STATE

from safedpa.bus import TAKEOVER, WISH, AbstractNode, Inputs, ModelMessage, Outputs, StateMessage, TakeoverMessage
from safedpa.dynamics import load_model
from safedpa.errors import InputError
from safedpa_services import trying as module

PERIOD = 0.05
OFFER = ModelMessage(**STAMP, step="offer", change=4, fingerprint="b" * 8, replaces="", document="d", margin="m")


class Node(AbstractNode):
    """A node whose step with the new model takes ``costs`` [s] of the processor in turn; what it was told, in order."""

    name, inputs, outputs, share = "policy", (), (WISH,), 0.2

    def __init__(self, costs: list[float], answer: str | None) -> None:
        self.costs, self.answer, self.now = costs, answer, 0.0
        self.told: list[Any] = []
        self.taken = False

    def hear(self, robot: str, message: Any) -> None:
        self.told.append((message.step, message.from_tick, message.document))
        self.taken |= message.step == "take"

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        self.told.append(state.tick)
        if self.taken:
            self.now += self.costs.pop(0)
        return {}

    def afterwards(self, robot: str) -> Outputs:
        if self.answer is None or len(self.told) < 2:
            return {}
        return {TAKEOVER: TakeoverMessage(
            **STAMP, service="policy", change=4, fingerprint="b" * 8, state=self.answer, reason="it does not fit"
        )}  # fmt: skip


def tried(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "time", SimpleNamespace(process_time=lambda: node.now))
    model = load_model("car")
    state = StateMessage(**{**vars_of(STATE), "tick": 70, "period": PERIOD})
    module._take(node, "r1", OFFER, state, (model, model))


def vars_of(message: StateMessage) -> dict[str, Any]:
    return {name: getattr(message, name) for name in message.__dataclass_fields__}


@pytest.mark.parametrize(
    ("costs", "refused"),
    [
        ([0.012] * 10, False),
        ([0.013] * 10, True),
        ([0.001] * 6 + [0.5] * 4, False),  # what else the machine does
        ([0.001] * 4 + [0.02] * 6, True),
    ],
)
def test_a_tick_with_an_offered_model_may_usually_take_a_quarter_of_the_period(
    costs: list[float], refused: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of ten ticks at 20 Hz: 12.5 ms. It is offered at one tick and taken at the next, as in the service."""
    node = Node(list(costs), "ready")
    if refused:
        with pytest.raises(InputError, match=r"takes (13|20)\.0 ms of the processor, wanted at most 12\.5 ms"):
            tried(node, monkeypatch)
    else:
        tried(node, monkeypatch)
    assert node.told == [70, ("offer", 0, "d"), 71, ("take", 72, ""), *range(72, 82)]
    assert node.costs == []


@pytest.mark.parametrize(("answer", "said"), [(None, "it gave no answer"), ("refused", "it does not fit")])
def test_a_node_that_refuses_or_says_nothing_is_asked_no_further(
    answer: str | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    node = Node([], answer)
    with pytest.raises(InputError, match=f"^{said}$"):
        tried(node, monkeypatch)
    assert node.told == [70, ("offer", 0, "d"), 71]
