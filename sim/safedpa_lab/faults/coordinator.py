"""``python -m safedpa_lab.faults.coordinator``: the part of the diagnosis that changes models, with an effect at hand.

The product's own diagnosis needs half a minute of driving before it proposes an effect. This one proposes a steering
offset of 0.01 rad at once; how the change is made, kept and repaired is the product's code.
"""

from __future__ import annotations

import argparse
import dataclasses
import uuid
from pathlib import Path
from typing import final

from safedpa.bus import (
    HEALTH,
    MODEL,
    NO_ROBOT,
    TAKEOVER,
    AbstractNode,
    Answer,
    HealthMessage,
    Inputs,
    Message,
    Outputs,
    Request,
    ServiceLoop,
    StateMessage,
    TakeoverMessage,
)
from safedpa.bus.service.process import StopSignal, add_bus_options, bus_from_options, run_process
from safedpa.dynamics import fingerprint, load_model, parse_model, write_model
from safedpa.errors import SafedpaError
from safedpa.live.change import ModelChanges
from safedpa.live.versions import ModelVersion, OfferedEffect, VersionFolder
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import margin_text

EFFECT = "steering_offset"
FINDING = 1
_ADDED = f'\n[[effects]]\nname = "{EFFECT}"\nangle = 0.01\n'


@final
class _Coordinator(AbstractNode):
    name = "diagnosis"
    inputs = ()
    outputs = (MODEL,)
    listens = (TAKEOVER, HEALTH)
    share = 0.9

    def __init__(self, folder: Path) -> None:
        first, self._candidate = _versions()
        self._changes = ModelChanges(first, VersionFolder(folder))

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot, inputs
        if self._changes.fingerprint != self._candidate.fingerprint:
            self._changes.propose(FINDING, {EFFECT: self._candidate})
        message = self._changes.step(state)
        return {} if message is None else {MODEL: message}

    def hear(self, robot: str, message: Message) -> None:
        del robot
        if isinstance(message, (TakeoverMessage, HealthMessage)):
            self._changes.hear(message)

    def answer(self, _robot: str, request: Request) -> Answer:
        return self._changes.answer(request)


def _versions() -> tuple[ModelVersion, OfferedEffect]:
    """The shipped car, and the same with the effect; its margin is the shipped one, measured or not."""
    model = load_model("car")
    changed = parse_model(write_model(model) + _ADDED)
    margin = margin_for(model)
    if margin is None:
        raise SafedpaError("coordinator: the shipped car has no margin; the package is incomplete")
    own = margin_text(dataclasses.replace(margin, fingerprint=fingerprint(changed)))
    first = ModelVersion(fingerprint(model), write_model(model), margin_text(margin))
    return first, OfferedEffect(EFFECT, fingerprint(changed), write_model(changed), own)


def _work(options: argparse.Namespace, stop: StopSignal) -> int:
    node = _Coordinator(Path(options.out))
    with bus_from_options(options) as bus:
        bus.answer_requests(node.answer)
        bus.announce(NO_ROBOT, node.name, uuid.uuid4().hex[:12])
        ServiceLoop(node, bus).run(stop)
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="safedpa-coordinator")
    add_bus_options(parser)
    parser.add_argument("--out", required=True, metavar="FOLDER", help="keeps the versions that were agreed on")
    run_process(_work, parser)
