"""Which models ``safedpa up`` drives, and by which command."""

from pathlib import Path

import pytest

from safedpa.api import deployment as model_deployment
from safedpa.api.deployment import drive_command, refusal_reason
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.user_files import EFFECTS_VARIABLE
from safedpa.systems.robots import robot_named


def _at(name, period):
    model = load_model(name)
    return PhysicsModel(model.base, list(model.effects), dict(model.settings), period)


@pytest.mark.parametrize("name", ["car_learned", "car_rma_p", "pendulum_learned"])
@pytest.mark.parametrize(("times", "refused"), [(1.0, False), (1.009, False), (0.98, True), (1.02, True), (2.0, True)])
def test_networks_are_driven_only_at_the_rate_of_their_training(name, times, refused):
    """Networks predict one tick: at twice the rate they would predict twice the motion per time."""
    model = load_model(name)
    rate = robot_named(model.system.name).of_system(model.system).rate
    notice = refusal_reason(_at(name, times / rate))
    if refused:
        assert notice.startswith(f"its networks were trained for {rate / times:g} ticks per second")
        assert notice.endswith(f"driven at {rate:g}")
    else:
        assert notice == ""


def test_equations_are_driven_at_any_rate():
    assert refusal_reason(_at("car", 0.01)) == ""


def test_a_model_without_a_learned_policy_is_refused_for_that_and_not_for_its_rate():
    assert "wanted one with learned policies" in refusal_reason(load_model("point_learned"))


MODEL, MINE = Path("m"), Path("mine.py")


@pytest.mark.parametrize(
    ("name", "own_robot", "file", "named", "margin", "period", "command"),
    [
        ("car", False, None, "", None, 0.0, "--model m"),
        ("pendulum", False, None, "", None, 0.0, "--robot pendulum --model m"),
        ("pendulum", True, MINE, "", None, 0.0, "--robot-file mine.py --model m"),
        ("pendulum", False, MINE, "", None, 0.0, "--robot pendulum --effects mine.py --model m"),
        ("car", False, None, ":theirs.py", None, 0.0, "--effects theirs.py --model m"),
        ("car", False, MINE, "theirs.py", None, 0.0, "--effects mine.py --model m"),
        ("car", False, None, "", Path("two words"), 0.0, "--model m --margin 'two words'"),
        ("car", False, None, "", None, 0.05, "--model m"),
        ("car", False, None, "", None, 0.1, "--model m --rate 10"),
        ("car", False, None, "", None, 5.0, "--model m"),
    ],
)
def test_the_drive_command_names_only_what_is_not_a_default_or_in_the_users_file(
    name, own_robot, file, named, margin, period, command,
    monkeypatch,
):  # fmt: skip
    monkeypatch.setattr(model_deployment, "own_robots", lambda: {name} if own_robot else set())
    model = load_model(name)
    monkeypatch.setenv(EFFECTS_VARIABLE, named)
    assert drive_command(model, MODEL, margin, file, period) == f"safedpa up {command}"
