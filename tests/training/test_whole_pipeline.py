"""All four phases in small, from nothing: what they reach, and that what they make drives."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from safedpa.adaptation import AdaptationNode
from safedpa.dynamics import load_model
from safedpa.policy import PolicyNode
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.shipped import settings_named
from safedpa_services.command_line import safedpa
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.core import CarRobot
from safedpa_sim.robots.scene import Scene

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("trained")
    assert safedpa.run(["train", "car", "--small", "--phases", "1a,1b,2,3", "--out", str(out)]) == 0
    return out


@pytest.mark.slow
def test_every_phase_reaches_its_figure(trained: Path) -> None:
    told = json.loads((trained / "progress.json").read_text())
    assert min(told["1a"]["explained"]) > 0.93  # share of each increment's variance
    curve = told["1b"]["learning_curve"]
    assert curve[-1]["reward"] > curve[0]["reward"] + 1.0
    assert curve[0]["steps"] < 0.5 * told["1b"]["steps"]
    assert told["1b"]["nearest"] < 0.8 * curve[0]["nearest"]
    assert told["1b"]["success"] > 0.15
    assert max(told["2"]["explained"]) > 0.15  # phi sees what a history can show of z; some of it no history shows
    assert told["3"]["times_better"]["one_step"] > 2.0
    assert told["3"]["times_better"]["20_steps"] > 1.5
    assert list(trained.glob("checkpoint_*.pt")) == [], "checkpoints go when the training is done"


@pytest.mark.slow
def test_what_was_trained_drives_behind_the_filter(trained: Path) -> None:
    model = load_model(trained / "car_learned.toml")
    nodes = [AdaptationNode(model), PolicyNode(model), SafetyFilterNode(model, settings_named("car"))]
    robot = CarRobot(Scene.random(3, "box"), 0.05)
    fallbacks = 0
    for tick in drive(robot, nodes, 100):
        fallbacks += tick.verdict.status == "fallback"
    assert fallbacks == 0
    assert not robot.collisions
