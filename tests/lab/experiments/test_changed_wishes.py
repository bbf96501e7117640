"""What an experiment changes about the wishes of a policy."""

from __future__ import annotations

import dataclasses
import itertools

import pytest

from safedpa.bus import WISH, AbstractNode, Inputs, Outputs, StateMessage, WishMessage
from safedpa.policy import PolicyNode
from safedpa_lab.experiments.car_conditions import QuickerPolicyNode
from safedpa_lab.experiments.car_drives import ExploringPolicyNode

STATE = StateMessage(
    epoch=1, tick=3, robot_time=0.15, publish_time=0.0, values=(0.0,) * 4, applied=(0.0,) * 2, applied_by="filter",
    period=0.05, lockstep=True, goal=(), obstacles=(), field=(), footprint=(),
)  # fmt: skip


class Says(AbstractNode):
    """Always the same wish."""

    name, inputs, outputs = PolicyNode.name, PolicyNode.inputs, PolicyNode.outputs

    def __init__(self, *values: float) -> None:
        self.values = values
        self.forgotten: list[str] = []

    def step(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        del robot, inputs
        wish = WishMessage(
            epoch=1, tick=state.tick, robot_time=0.0, publish_time=0.0, values=self.values, controller="test"
        )
        return {WISH: wish}

    def forget(self, robot: str) -> None:
        self.forgotten.append(robot)


def wished(node: AbstractNode, state: StateMessage = STATE) -> tuple[float, ...]:
    wish = node.step("car", state, {})[WISH]
    assert isinstance(wish, WishMessage)
    return wish.values


@pytest.mark.parametrize(
    ("values", "wanted"), [((0.5, 0.2), (1.0, 0.2)), ((-0.5, 0.2), (-0.5, 0.2)), ((0.0, -0.1), (0.0, -0.1))]
)
def test_only_driving_forwards_is_quicker(values: tuple[float, ...], wanted: tuple[float, ...]) -> None:
    assert wished(QuickerPolicyNode(Says(*values), 2.0)) == wanted


def test_a_quicker_policy_takes_the_place_of_its_policy_and_forgets_with_it() -> None:
    policy = Says(0.5, 0.0)
    node = QuickerPolicyNode(policy, 2.0)
    node.forget("car_7")
    assert policy.forgotten == ["car_7"]
    assert (node.name, node.inputs, node.outputs) == (PolicyNode.name, PolicyNode.inputs, PolicyNode.outputs)


def test_an_explored_action_lasts_for_its_time_and_stays_within_the_bounds() -> None:
    node, told = ExploringPolicyNode(Says(0.6, 0.1), 4), list[tuple[float, ...]]()
    for tick in range(200):
        told.append(wished(node, dataclasses.replace(STATE, tick=tick, robot_time=0.05 * tick)))
    starts = [0, *(tick for tick in range(1, 200) if told[tick] != told[tick - 1])]
    held = [0.05 * (end - start) for start, end in itertools.pairwise(starts)]
    assert len(held) > 5
    assert min(held) >= 0.4 - 1e-9
    assert max(held) <= 1.5 + 0.05 + 1e-9
    assert all(-0.6 <= speed <= 2.0 and abs(steer) <= 0.34 for speed, steer in told)
