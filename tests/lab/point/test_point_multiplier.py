"""The Lagrange multiplier: what it does while nothing is learned yet, and how it follows the cost afterwards."""

from __future__ import annotations

import pytest

from safedpa.errors import InputError
from safedpa_lab.point.multiplier import STANDING_STILL, Multiplier
from safedpa_lab.point.plan import Plan
from safedpa_lab.point.vector_environment import PointEnvironment
from safedpa_sim.point.task import PointTask


def _rollouts(plan: Plan, episode_costs: list[float], returns: float) -> list[float]:
    """The weights after rollouts of such costs, while episodes gain ``returns``."""
    environment = PointEnvironment(PointTask(2, 0))
    environment.returns.append(returns)
    multiplier, weights = Multiplier(environment, plan, rate=0.01), []
    for cost in episode_costs:
        multiplier.on_rollout_start()
        environment.paid, environment.stepped = 5.0 * cost, 5_000
        multiplier.on_rollout_end()
        weights.append(environment.weight)
    return weights


def test_the_integral_grows_with_the_excess_and_never_below_nothing() -> None:
    plan = Plan(limit=25.0, multiplier="integral")
    assert _rollouts(plan, [35.0, 35.0, 5.0, 5.0], -9.0) == pytest.approx([0.1, 0.2, 0.0, 0.0])


def test_it_has_no_cap_unless_one_is_asked_for() -> None:
    long = [100.0] * 40
    assert _rollouts(Plan(limit=0.0, multiplier="integral"), long, 0.0)[-1] == pytest.approx(40.0)
    assert _rollouts(Plan(limit=0.0, multiplier="integral", cap=1.0), long, 0.0)[-1] == 1.0


def test_a_waiting_multiplier_does_not_wind_up_while_nothing_is_gained() -> None:
    plan = Plan(limit=1.0, multiplier="waiting")
    assert _rollouts(plan, [80.0] * 50, STANDING_STILL - 0.1) == [0.0] * 50
    assert _rollouts(plan, [80.0] * 2, STANDING_STILL + 0.1) == pytest.approx([0.79, 1.58])


def test_the_proportional_part_falls_back_with_the_cost() -> None:
    """After a long high cost the controller lets go sooner than its integral."""
    costs = [50.0] * 20 + [10.0] * 30
    plan = Plan(limit=20.0, multiplier="pid")
    controlled = _rollouts(plan, costs, 5.0)
    integral = _rollouts(Plan(limit=20.0, multiplier="integral"), costs, 5.0)
    assert controlled[0] > integral[0], "a sudden cost is answered at once"
    assert controlled[19] > integral[19]
    assert controlled[-1] < integral[-1]
    assert min(controlled) >= 0.0


def test_an_unknown_multiplier_and_unknown_inputs_are_refused() -> None:
    with pytest.raises(InputError, match="multiplier 'pdi'"):
        Plan(multiplier="pdi")
    with pytest.raises(InputError, match="inputs 'camera'"):
        Plan(inputs="camera")
