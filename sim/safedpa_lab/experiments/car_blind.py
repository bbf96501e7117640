"""A safety filter whose model knows no latent, next to an adaptation and a policy that do."""

from __future__ import annotations

import dataclasses
from typing import final

from safedpa.bus import LATENT, AbstractNode, Inputs, LatentMessage, Outputs, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.errors import InputError
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings
from safedpa.safety.margins.calibration import MarginCalibration

__all__ = ["BlindFilterNode"]


@final
class BlindFilterNode(AbstractNode):
    """The real filter with a model without latent: what the adaptation says of another model reaches it empty.

    So the ablations Fix and Mix differ from SafeDPA in the filter's f and g alone. Raises InputError when the model
    has a latent after all.
    """

    name = SafetyFilterNode.name
    inputs = SafetyFilterNode.inputs
    outputs = SafetyFilterNode.outputs
    share = SafetyFilterNode.share

    def __init__(self, model: PhysicsModel, settings: FilterSettings, margin: MarginCalibration | None) -> None:
        if model.latent_names:
            raise InputError(
                f"blind filter: got a model with latent {', '.join(model.latent_names)}, wanted one without; "
                "give it to adaptation and filter alike"
            )
        self._filter = SafetyFilterNode(model, settings, margin)
        self._fingerprint = fingerprint(model)

    def prepare(self, robot: str, state: StateMessage) -> None:  # noqa: D102
        self._filter.prepare(robot, state)

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        latent = inputs[LATENT]
        if isinstance(latent, LatentMessage):
            empty = dataclasses.replace(latent, model=self._fingerprint, values=(), deviations=())
            inputs = {**inputs, LATENT: empty}
        return self._filter.step(robot, state, inputs)

    def afterwards(self, robot: str) -> Outputs:  # noqa: D102
        return self._filter.afterwards(robot)

    def forget(self, robot: str) -> None:  # noqa: D102
        self._filter.forget(robot)
