"""The planner as one of the policy service's controllers, from the command line down."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safedpa.bus import LATENT, WISH, Stale, WishMessage
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments.controllers import controllers_experiment
from safedpa_services.command_line import up
from safedpa_services.supervisor.plan import Plan
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene


def plan(controller: str) -> Plan:
    return Plan(
        robot="car",
        name="r1",
        load="none",
        seconds=1.0,
        seed=0,
        rate=20.0,
        lockstep=True,
        filtered=True,
        dashboard=False,
        model="car",
        settings="car",
        margin="",
        controller=controller,
        fleet="fleet",
        endpoint="tcp/127.0.0.1:1",
        folder=Path(),
    )


def test_the_policy_service_is_started_with_the_chosen_controller() -> None:
    policy = next(child for child in plan("planner").services() if child.name == "policy")
    at = policy.arguments.index("--controller")
    assert policy.arguments[at + 1] == "planner"
    assert all("--controller" not in child.arguments for child in plan("").services())


def test_a_controller_that_the_model_cannot_have_is_refused_before_anything_starts(tmp_path: Path) -> None:
    result = CliRunner().invoke(up.command, ["--controller", "learned", "--headless", "--out", str(tmp_path)])
    assert "no networks" in str(result.exception)
    assert not list(tmp_path.iterdir())


def test_the_node_sends_the_planners_wish() -> None:
    state = CarRobot(Scene.random(3, "none"), 0.05).state_message()
    node = PolicyNode(load_model("car"), controller="planner")
    wish = node.step("r1", state, {LATENT: Stale(LATENT, None)})[WISH]
    assert isinstance(wish, WishMessage)
    assert wish.controller == "planner"
    assert len(wish.values) == 2


def test_a_small_comparison_counts_every_drive() -> None:
    told: list[tuple[int, int, dict[str, Any]]] = []
    result = controllers_experiment(
        load_model("car"), settings_named("car"), ("goal_seeker", "planner"), (201,), 3.0, lambda *at: told.append(at)
    )
    assert [(row["load"], row["controller"]) for row in result["rows"][:2]] == [
        ("none", "goal_seeker"),
        ("none", "planner"),
    ]
    assert told == [(1, 1, result)]
    assert all(row["drives"] == 1 and row["collisions"] == 0 for row in result["rows"])
    assert all(row["milliseconds_p99"] >= row["milliseconds_p50"] > 0.0 for row in result["rows"])


@pytest.mark.parametrize("name", ["planer", ""])
def test_unknown_controllers_are_refused(name: str) -> None:
    with pytest.raises(Exception, match="controller"):
        PolicyNode(load_model("car"), controller=name)
