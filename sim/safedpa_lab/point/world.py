"""One point robot in MuJoCo: what the batched simulation is compared with, and what the experiments drive in."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa_lab.point.mjcf import point_model
from safedpa_sim.point.body import POINT_BODY, SUBSTEPS, PointBody

__all__ = ["MujocoPoint"]


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
