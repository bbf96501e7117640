"""A model exported to other simulators: MuJoCo moves like the model, and missing effects are reported."""

import json
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.model_file import parse_model
from safedpa.robots.pendulum.simulator_export import simulator_export
from safedpa_services.command_line.group import safedpa

MODEL = """
format = 1
robot = "pendulum"
period = 0.01
[base]
kind = "rigid_pendulum"
length = 0.5
mass = 0.6
gravity = 9.81
[[effects]]
name = "{name}"
{parameters}
"""
CASES = {
    "viscous_friction": "coefficient = 0.2",
    "spring": "stiffness = 1.5\nrest_angle = 0.4",
    "tip_mass": "mass = 0.3",
    "torque_gain": "gain = 0.7",
    "torque_offset": "offset = 0.15",
    "torque_lag": "time_constant = 0.08",
}
TORQUE = 0.4


def moved(model: PhysicsModel, seconds: float) -> float:
    """Returns the angle [rad] after a time under a constant torque, from 0.3 rad at rest."""
    text = simulator_export(model).documents["pendulum.mjcf.xml"]
    world = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(world)
    data.qpos[0], data.ctrl[0] = 0.3, TORQUE
    while data.time < seconds - 1e-9:
        mujoco.mj_step(world, data)
    return float(data.qpos[0])


@pytest.mark.parametrize("name", CASES)
def test_mujoco_moves_as_the_model_does(name: str) -> None:
    model = parse_model(MODEL.format(name=name, parameters=CASES[name]), Path())
    state, memory = np.array([0.3, 0.0]), model.initial_memory(np.zeros(1))
    for _ in range(50):
        state, memory = model.advance(state, np.array([TORQUE]), memory=memory)
    assert moved(model, 0.5) == pytest.approx(float(state[0]), abs=4e-3)
    plain = parse_model(MODEL.format(name="viscous_friction", parameters="coefficient = 0.0"), Path())
    assert abs(moved(plain, 0.5) - moved(model, 0.5)) > 0.02


def test_everything_is_written_and_effects_that_cannot_be_expressed_are_reported(tmp_path, capsys):
    path = tmp_path / "found.toml"
    path.write_text(MODEL.format(name="wind", parameters="speed = 1.0\ndrag = 0.1\nupward = 0.0"))
    out = tmp_path / "out"
    assert safedpa.run(["export", str(path), "--format", "simulators", "--out", str(out)]) == 0
    notice = capsys.readouterr()
    assert "pendulum.urdf: cannot express wind: URDF has no wind" in notice.err
    table = json.loads((out / "parameters.json").read_text())
    assert table["effects"][0]["parameters"]["drag"] == {"value": 0.1, "unit": "N s2/m2"}
    assert table["unexpressed"]["pendulum.urdf"] == {"wind": "URDF has no wind"}
    dynamics = ElementTree.parse(out / "pendulum.urdf").find("joint/dynamics")
    assert dynamics is not None
    assert dynamics.attrib == {"damping": "0.0", "friction": "0.0"}
    assert safedpa.run(["export", "car", "--format", "simulators", "--out", str(tmp_path / "car")]) == 0
    plugin = ElementTree.parse(tmp_path / "car" / "car.gazebo.sdf").getroot()
    assert plugin.findtext("wheel_base") == "0.32"
    assert load_model("car").system.name == "car"
    assert "cannot express towed_load: hang a model on a hitch joint" in capsys.readouterr().err
