"""Export of the pendulum to MuJoCo and URDF. Angle 0 is upright there too: the mass starts above the hinge."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.simulator_export import SimulatorExport

_MJCF_CANNOT: Final[Mapping[str, str]] = {
    "stribeck_friction": "MuJoCo's dry friction does not fade with the rate; add it as a control",
    "torque_delay": "delay the control signal",
    "wind": "set option wind, density and the geometry's fluid coefficients by hand",
    "angle_offset": "add it to the sensor's reading",
    "backlash": "add a second joint with a small range",
}
_URDF_CANNOT: Final[Mapping[str, str]] = {
    **_MJCF_CANNOT,
    "stribeck_friction": "URDF's friction does not fade with the rate",
    "wind": "URDF has no wind",
    "spring": "URDF has no springs; SDF has spring_stiffness and spring_reference",
    "torque_gain": "scale the command",
    "torque_offset": "add it to the command",
    "torque_lag": "filter the command",
}


def simulator_export(model: PhysicsModel) -> SimulatorExport:
    """Returns MJCF with joint and actuator parameters, URDF with damping and friction, and hints for other effects."""
    there = {item.name for item in model.effects}
    return SimulatorExport(
        {"pendulum.mjcf.xml": _mjcf(model), "pendulum.urdf": _urdf(model)},
        {
            "pendulum.mjcf.xml": {name: why for name, why in _MJCF_CANNOT.items() if name in there},
            "pendulum.urdf": {name: why for name, why in _URDF_CANNOT.items() if name in there},
        },
    )


def _value(model: PhysicsModel, path: str, otherwise: float = 0.0) -> float:
    setting = model.settings.get(path)
    return otherwise if setting is None else float(setting.value)


def _mass(model: PhysicsModel) -> float:
    return _value(model, "base.mass") + _value(model, "tip_mass.mass")


def _mjcf(model: PhysicsModel) -> str:
    length, mass = _value(model, "base.length"), _mass(model)
    gain, offset = _value(model, "torque_gain.gain", 1.0), _value(model, "torque_offset.offset")
    lag = _value(model, "torque_lag.time_constant")
    dynamics = f'dyntype="filterexact" dynprm="{lag!r}" ' if lag > 0.0 else ""
    joint = f'damping="{_value(model, "viscous_friction.coefficient")!r}" '
    joint += f'frictionloss="{_value(model, "coulomb_friction.torque")!r}" '
    joint += f'stiffness="{_value(model, "spring.stiffness")!r}" springref="{_value(model, "spring.rest_angle")!r}"'
    tiny = f"{1e-9 * mass * length * length!r}"
    return f"""<mujoco model="pendulum">
  <compiler angle="radian"/>
  <option gravity="0 0 {-_value(model, "base.gravity")!r}" timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" type="hinge" axis="0 1 0" {joint}/>
      <inertial pos="0 0 {length!r}" mass="{mass!r}" diaginertia="{tiny} {tiny} {tiny}"/>
      <geom type="capsule" fromto="0 0 0 0 0 {length!r}" size="0.01" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator>
    <general name="torque" joint="hinge" {dynamics}gainprm="{gain!r}" biastype="affine" biasprm="{offset!r} 0 0"/>
  </actuator>
</mujoco>
"""


def _urdf(model: PhysicsModel) -> str:
    length, mass = _value(model, "base.length"), _mass(model)
    tiny = f"{1e-9 * mass * length * length!r}"
    damping, friction = _value(model, "viscous_friction.coefficient"), _value(model, "coulomb_friction.torque")
    return f"""<robot name="pendulum">
  <link name="base"/>
  <joint name="hinge" type="continuous">
    <parent link="base"/>
    <child link="rod"/>
    <axis xyz="0 1 0"/>
    <dynamics damping="{damping!r}" friction="{friction!r}"/>
  </joint>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 {length!r}"/>
      <mass value="{mass!r}"/>
      <inertia ixx="{tiny}" iyy="{tiny}" izz="{tiny}" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
</robot>
"""
