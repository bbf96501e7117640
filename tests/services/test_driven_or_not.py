"""Which models ``safedpa up`` drives, told before anybody tries."""

from __future__ import annotations

import pytest

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.robot import robot_named
from safedpa_services.driving import why_refused


def _at(name: str, period: float) -> PhysicsModel:
    model = load_model(name)
    return PhysicsModel(model.base, list(model.effects), dict(model.settings), period)


@pytest.mark.parametrize("name", ["car_learned", "car_rma_p", "pendulum_learned"])
@pytest.mark.parametrize(("times", "refused"), [(1.0, False), (1.009, False), (0.98, True), (1.02, True), (2.0, True)])
def test_networks_are_driven_at_the_rate_of_their_training_alone(name: str, times: float, refused: bool) -> None:
    """A tick is what they predict: asked twice as often they would say that the robot goes half as far."""
    model = load_model(name)
    rate = robot_named(model.system.name).of_system(model.system).rate
    said = why_refused(_at(name, times / rate))
    if refused:
        assert said.startswith(f"its networks were trained for {rate / times:g} ticks per second")
        assert said.endswith(f"driven at {rate:g}")
    else:
        assert said == ""


def test_equations_are_driven_at_any_rate() -> None:
    assert why_refused(_at("car", 0.01)) == ""


def test_what_no_policy_was_learned_for_is_refused_by_that_and_not_by_its_rate() -> None:
    assert "wanted one with learned policies" in why_refused(load_model("point_learned"))
