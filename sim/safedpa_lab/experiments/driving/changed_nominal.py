"""A policy whose nominal actions an experiment changes on their way to the filter."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod

from safedpa.bus import NOMINAL, AbstractNode, Inputs, NominalMessage, Outputs, StateMessage
from safedpa.policy import PolicyNode


class ChangedNominal(AbstractNode):
    """Replaces the policy's node on the bus and publishes ``changed`` of each of its nominal actions."""

    name = PolicyNode.name
    inputs = PolicyNode.inputs
    outputs = PolicyNode.outputs
    share = PolicyNode.share

    def __init__(self, policy: AbstractNode) -> None:
        self._policy = policy

    @abstractmethod
    def changed(self, values: tuple[float, ...], state: StateMessage) -> tuple[float, ...]:
        """The nominal action (actions,) in place of the policy's, in the action's units."""

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        outputs = dict(self._policy.step(robot, state, inputs))
        nominal = outputs[NOMINAL]
        assert isinstance(nominal, NominalMessage)
        outputs[NOMINAL] = dataclasses.replace(nominal, values=self.changed(nominal.values, state))
        return outputs

    def forget(self, robot: str) -> None:  # noqa: D102
        self._policy.forget(robot)
