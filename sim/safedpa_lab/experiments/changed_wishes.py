"""A policy whose wishes an experiment changes on their way to the filter."""

from __future__ import annotations

import dataclasses
from abc import abstractmethod

from safedpa.bus import WISH, AbstractNode, Inputs, Outputs, StateMessage, WishMessage
from safedpa.policy import PolicyNode

__all__ = ["ChangedWishes"]


class ChangedWishes(AbstractNode):
    """Stands on the bus where the policy's node stands, and tells ``changed`` of each of its wishes."""

    name = PolicyNode.name
    inputs = PolicyNode.inputs
    outputs = PolicyNode.outputs
    share = PolicyNode.share

    def __init__(self, policy: AbstractNode) -> None:
        self._policy = policy

    @abstractmethod
    def changed(self, values: tuple[float, ...], state: StateMessage) -> tuple[float, ...]:
        """The wish (actions,) in place of the policy's, in the action's units."""

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:  # noqa: D102
        outputs = dict(self._policy.step(robot, state, inputs))
        wish = outputs[WISH]
        assert isinstance(wish, WishMessage)
        outputs[WISH] = dataclasses.replace(wish, values=self.changed(wish.values, state))
        return outputs

    def forget(self, robot: str) -> None:  # noqa: D102
        self._policy.forget(robot)
