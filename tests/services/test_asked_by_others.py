"""Other commands that start a drive set all options that ``safedpa up`` has."""

import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner

from safedpa.systems.robots import robots
from safedpa_services.command_line import demo, serve
from safedpa_services.command_line.up import make_plan
from safedpa_services.supervisor.plan import Plan

EXAMPLES = Path(__file__).parents[2] / "docs" / "examples"


class EnoughError(Exception):
    """Raised instead of starting a drive."""


@pytest.fixture
def plans(monkeypatch: pytest.MonkeyPatch) -> list[Plan]:
    """The plans that would have been driven."""
    seen: list[Plan] = []

    def drives(plan: Plan, *_: Any) -> None:
        seen.append(plan)
        raise EnoughError

    @contextmanager
    def plans(options: dict[str, Any], own: Any) -> Iterator[Plan]:
        with make_plan(options, own) as plan:
            drives(plan)
            yield plan

    monkeypatch.setattr(demo, "run_plan", drives)
    monkeypatch.setattr(serve, "make_plan", plans)
    return seen


def begun(command: Any, *phrase: str) -> None:
    """Runs a command up to the start of the drive."""
    assert isinstance(CliRunner().invoke(command, list(phrase)).exception, EnoughError)


def test_the_demonstration_drives_the_car_whose_steering_is_bent(plans: list[Plan], tmp_path: Path) -> None:
    begun(demo.command, "--yes", "--headless", "--seed", "7", "--out", str(tmp_path))
    (plan,) = plans
    assert (plan.robot, plan.seed, plan.change, plan.change_after) == ("car", 7, "steering_offset", 25.0)
    assert (plan.model, plan.load, plan.diagnosis, plan.sensor_inputs) == ("car_measured", "none", True, False)
    assert plan.folder.parent == tmp_path


@pytest.mark.parametrize("robot", sorted(robots()))
def test_every_robot_that_ships_is_served(plans: list[Plan], tmp_path: Path, robot: str) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(f'format = 2\nrobot = "{robot}"\nname = "own"\n', encoding="utf-8")
    begun(serve.command, str(file), "--headless", "--policy", "random", "--out", str(tmp_path))
    (plan,) = plans
    assert (plan.robot, plan.name, plan.controller, plan.dashboard) == (robot, "own", "random", False)
    assert plan.rate == robots()[robot].rate


def test_the_example_of_the_pages_is_served(plans: list[Plan], tmp_path: Path) -> None:
    begun(serve.command, str(EXAMPLES / "turtlebot.toml"), "--headless", "--no-diagnosis", "--out", str(tmp_path))
    (plan,) = plans
    assert (plan.robot, plan.name, plan.rate, plan.diagnosis) == ("differential_drive", "turtlebot", 20.0, False)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.processes
def test_the_demonstration_drives(tmp_path: Path) -> None:
    """The whole of it takes minutes (safedpa experiment demo); here until its diagnosis has begun to learn."""
    phrase = [sys.executable, "-m", "safedpa_services", "demo", "--yes", "--headless", "--out", str(tmp_path)]
    with subprocess.Popen(phrase, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        notice = [next(process.stdout) for _ in range(3)]
        process.send_signal(signal.SIGINT)
        out, error = process.communicate(timeout=120.0)
    assert notice[0].startswith("Starting a simulated car")
    assert "its steering is bent" in notice[1]
    assert "still learning the usual error" in notice[2]
    assert out.startswith("Drove for ")
    assert "0 collisions" in out
    assert error.startswith("safedpa: demo: drove for ")
    assert error.count("\n") == 1
    assert process.returncode == 1
