"""Export of the car to Gazebo: parameters of the Ackermann steering plugin, and hints for effects that it lacks."""

from __future__ import annotations

from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.simulator_export import SimulatorExport

_FILE = "car.gazebo.sdf"
_INSTEAD = {
    "payload": "multiply the mass of the chassis by 1 + mass_ratio",
    "towed_load": "hang a model on a hitch joint",
    "quadratic_drag": "add the plugin LiftDrag with the coefficient times mass",
    "viscous_drag": "add damping to the wheel joints: coefficient mass radius^2, over the driven wheels",
    "rolling_resistance": "add friction to the wheel joints: deceleration mass radius, over all wheels",
    "constant_force": "tilt gravity, or add the plugin WindEffects",
    "tyre_slip": "set slip compliance of the wheels (plugin WheelSlip)",
    "understeer": "set slip compliance of the front wheels (plugin WheelSlip)",
}
_MESSAGE = ("steering_saturation",)


def simulator_export(model: PhysicsModel) -> SimulatorExport:
    """Returns the plugin's parameters as SDF, and for every other effect how to model it in Gazebo."""
    known = {path: setting.value for path, setting in model.settings.items()}
    lines = [f"  <wheel_base>{known['base.wheelbase']!r}</wheel_base>"]
    limit = known.get("steering_saturation.limit")
    lines += [] if limit is None else [f"  <steering_limit>{limit!r}</steering_limit>"]
    fastest = known.get("base.acceleration_limit")
    if fastest is not None:
        lines += [f"  <min_acceleration>{-fastest!r}</min_acceleration>"]
        lines += [f"  <max_acceleration>{fastest!r}</max_acceleration>"]
    plugin = 'filename="gz-sim-ackermann-steering-system" name="gz::sim::systems::AckermannSteering"'
    text = "\n".join([f"<plugin {plugin}>", *lines, "</plugin>", ""])
    others = [item.name for item in model.effects if item.name not in _MESSAGE]
    without = "the plugin cannot model it; change the command or the measurement outside the plugin"
    return SimulatorExport({_FILE: text}, {_FILE: {name: _INSTEAD.get(name, without) for name in others}})
