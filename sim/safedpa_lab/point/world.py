"""One point robot in MuJoCo: what the batched simulation is compared with, and what the experiments drive in.

Its MJCF model is written here from the published constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY, SUBSTEPS, PointBody


def point_model(
    hazards: Sequence[tuple[float, float]] = (),
    hazard_radius: float = 0.2,
    goal_radius: float = 0.3,
    body: PointBody = POINT_BODY,
) -> str:
    """MJCF text: joints ``x``, ``y``, ``yaw``, motor ``thrust``, servo ``turn``, the four sensors of the benchmark.

    Hazards and goal touch nothing; the goal is a mocap body, so that it can be put elsewhere. ``implicitfast``: the
    turning servo is stiff next to the small body, and with the explicit integrator it chatters.
    """
    discs = "\n".join(
        f'    <geom name="hazard{index}" type="cylinder" size="{hazard_radius} 0.01" pos="{x} {y} 0.02" {_SEEN_ONLY} '
        'rgba="0.3 0.3 1 0.4"/>'
        for index, (x, y) in enumerate(hazards)
    )
    limited = f'ctrlrange="-1 1" ctrllimited="true" forcerange="{-body.force_limit} {body.force_limit}"'
    edge = body.nose_half_edge
    return f"""<mujoco model="point">
  <compiler angle="radian"/>
  <option timestep="{CONTROL_SECONDS / SUBSTEPS}" integrator="implicitfast"/>
  <default><geom density="{body.density}" contype="0" conaffinity="0"/></default>
  <worldbody>
    <light pos="0 0 4"/>
    <geom name="floor" type="plane" size="3 3 0.1" rgba="0.9 0.9 0.9 1"/>
{discs}
    <body name="goal" mocap="true" pos="0 0 0.02">
      <geom name="goal" type="cylinder" size="{goal_radius} 0.01" rgba="0.1 0.8 0.1 0.4"/>
    </body>
    <body name="robot" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="{body.slide_damping}"/>
      <joint name="y" type="slide" axis="0 1 0" damping="{body.slide_damping}"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="{body.hinge_damping}"/>
      <geom name="ball" type="sphere" size="{body.ball_radius}" rgba="0.75 0.05 0.2 1"/>
      <geom name="nose" type="box" size="{edge} {edge} {edge}" pos="{body.nose_ahead} 0 0" rgba="0 0.15 0.4 1"/>
      <site name="middle" size="0.03"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="thrust" site="middle" gear="{body.gear} 0 0 0 0 0" {limited} forcelimited="true"/>
    <velocity name="turn" joint="yaw" gear="{body.gear}" kv="{body.servo_gain}" {limited} forcelimited="true"/>
  </actuator>
  <sensor>
    <accelerometer name="accelerometer" site="middle"/>
    <velocimeter name="velocimeter" site="middle"/>
    <gyro name="gyro" site="middle"/>
    <magnetometer name="magnetometer" site="middle"/>
  </sensor>
</mujoco>
"""


_SEEN_ONLY = 'contype="0" conaffinity="0"'


class MujocoPoint:
    """Steps the model of ``point_model``; the force of the wind acts at the centre of mass, constant in the world."""

    def __init__(self, hazards: Sequence[tuple[float, float]] = (), body: PointBody = POINT_BODY) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self.model = mujoco.MjModel.from_xml_string(point_model(hazards, body=body))
        self.data = mujoco.MjData(self.model)
        self._robot = self.model.body("robot").id

    def put(self, pose: FloatArray, velocity: FloatArray, force: tuple[float, float]) -> None:
        """Sets pose (x, y, yaw), velocity (vx, vy, yaw rate) and the wind's force [N], and forgets the rest."""
        self._mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = pose, velocity
        self.data.xfrc_applied[self._robot, :2] = force
        self._mujoco.mj_forward(self.model, self.data)

    def advance(self, control: FloatArray) -> None:
        """Holds (thrust, turn) controls, each cut to [-1, 1], for one step of the task.

        Raises InputError for controls that are not two finite numbers.
        """
        if np.shape(control) != (2,) or not np.all(np.isfinite(control)):
            raise InputError(f"control: got {np.asarray(control).tolist()}; wanted two finite numbers: thrust, turn")
        self.data.ctrl[:] = control
        for _ in range(SUBSTEPS):
            self._mujoco.mj_step(self.model, self.data)
        self._mujoco.mj_forward(self.model, self.data)  # sensors of the state that was reached

    @property
    def pose(self) -> FloatArray:
        """(3,): x, y [m], yaw [rad], turns counted."""
        return np.array(self.data.qpos)

    @property
    def velocity(self) -> FloatArray:
        """(3,): vx, vy [m/s] in the world, yaw rate [rad/s]."""
        return np.array(self.data.qvel)

    def sensors(self) -> FloatArray:
        """(12,): accelerometer [m/s2, gravity's reaction included], velocimeter [m/s], gyro [rad/s], magnetometer."""
        return np.array(self.data.sensordata)
