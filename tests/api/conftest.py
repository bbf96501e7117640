"""Files of a new user: a log of a pendulum whose hinge rubs, models with and without friction, a robot, a recording."""

import shutil
from pathlib import Path

import numpy as np
import pytest

from safedpa.dynamics import parse_model

FRICTIONLESS = """\
format = 1
robot = "pendulum"
period = 0.05

[base]
kind = "rigid_pendulum"
length = 1.0
mass = 1.0
gravity = 9.81
"""
FRICTION = FRICTIONLESS + '\n[[effects]]\nname = "viscous_friction"\ncoefficient = {}\n'
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def user_files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with log.csv, degrees.csv, frictionless.toml, friction.toml, drone.py, incomplete.py, drive.mcap."""
    folder = tmp_path_factory.mktemp("user")
    (folder / "frictionless.toml").write_text(FRICTIONLESS)
    (folder / "friction.toml").write_text(FRICTION.format(0.1))
    real = parse_model(FRICTION.format(0.2))
    random, state, rows = np.random.default_rng(7), np.array([3.1, 0.0]), []
    for t in np.arange(0.0, 30.0, 0.05):
        torque = 3.0 * np.sin(1.1 * t) + 2.0 * np.sin(0.37 * t)
        rows.append([t, *(state + random.normal(0.0, [0.003, 0.01])), torque])
        state = real.step(state, np.array([torque]))
    table = np.array(rows)
    np.savetxt(folder / "log.csv", table, delimiter=",", header="t,angle,rate,torque", comments="")
    table[:, 1] = np.degrees(table[:, 1])
    np.savetxt(folder / "degrees.csv", table, delimiter=",", header="time,theta_deg,rate,torque", comments="")
    for name in ("drone.py", "drone.toml"):
        shutil.copy(ROOT / "docs" / "examples" / "drone" / name, folder)
    drone = (folder / "drone.py").read_text(encoding="utf-8")
    (folder / "incomplete.py").write_text(drone.replace("def stand_in(", "def stand_in(*_): ...\n\n    def unused("))
    shutil.copy(ROOT / "tests" / "replay" / "golden" / "car_box.mcap", folder / "drive.mcap")
    return folder


@pytest.fixture
def user_folder(user_files: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of these files as the working directory."""
    shutil.copytree(user_files, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path
