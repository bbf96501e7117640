"""While a model is offered the adaptation learns for it as well, and no longer when the offer is dropped."""

import dataclasses

from safedpa.adaptation import AdaptationNode
from safedpa.bus import ModelMessage, StateMessage
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model

CAR = load_model("car")
DOCUMENT = write_model(CAR) + '\n[[effects]]\nname = "steering_offset"\nangle = 0.01\n'
NEW = fingerprint(parse_model(DOCUMENT))
STAMP = {"epoch": 1, "robot_time": 0.0, "publish_time": 0.0}


def test_a_model_that_was_dropped_is_learned_for_no_longer() -> None:
    """Its estimate would cost as much as that of the model in force in every tick to come."""
    node, ticks = AdaptationNode(CAR), iter(range(10))

    def turn() -> None:
        state = StateMessage(
            **STAMP, tick=next(ticks), values=(0.0,) * 4, applied=(0.0, 0.0), applied_by="filter", period=0.05,
            lockstep=True, goal=(1.0, 1.0), obstacles=(), field=(-4.0, 4.0, -4.0, 4.0), footprint=(0.1, 0.4, 0.1),
        )  # fmt: skip
        node.step("r1", state, {})
        node.afterwards("r1")

    offer = ModelMessage(
        **STAMP, tick=0, step="offer", change=1, fingerprint=NEW, replaces=fingerprint(CAR), document=DOCUMENT
    )
    turn()
    node.hear("r1", offer)
    turn()
    learned = node._robots["r1"].successor
    assert learned is not None
    assert learned[0].fingerprint == NEW
    node.hear("r1", dataclasses.replace(offer, step="drop", document=""))
    turn()
    assert node._robots["r1"].successor is None
