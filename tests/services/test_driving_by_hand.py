"""Which command drives a model: what it says of the robot, of the user's own file, of model and margin."""

from __future__ import annotations

from pathlib import Path

import pytest

from safedpa.dynamics import load_model
from safedpa.dynamics.own import EFFECTS_VARIABLE
from safedpa_services import driving as module
from safedpa_services.driving import drive_command


@pytest.mark.parametrize(
    ("name", "own_robot", "file", "named", "margin", "said"),
    [
        ("car", False, None, "", None, "--model m"),
        ("pendulum", False, None, "", None, "--robot pendulum --model m"),
        ("pendulum", True, Path("mine.py"), "", None, "--robot-file mine.py --model m"),
        ("pendulum", False, Path("mine.py"), "", None, "--robot pendulum --effects mine.py --model m"),
        ("car", False, None, ":theirs.py", None, "--effects theirs.py --model m"),
        ("car", False, Path("mine.py"), "theirs.py", None, "--effects mine.py --model m"),
        ("car", False, None, "", Path("two words"), "--model m --margin 'two words'"),
    ],
)
def test_a_robot_is_named_where_it_is_neither_the_usual_one_nor_in_the_users_file(
    name: str,
    own_robot: bool,
    file: Path | None,
    named: str,
    margin: Path | None,
    said: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "own_robots", lambda: {name} if own_robot else set())
    model = load_model(name)
    monkeypatch.setenv(EFFECTS_VARIABLE, named)
    assert drive_command(model, Path("m"), margin, file) == f"safedpa up {said}"
