"""What the dashboard must know of a robot beside its messages: names, units, limits, size of the drawn body."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from safedpa.bus import StateMessage
from safedpa.drawing import Shape
from safedpa.dynamics import PhysicsModel
from safedpa.robot import AbstractRobot, robot_like
from safedpa.safety.braking import Braking
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System
from safedpa_services.dashboard.wind import Wind, wind_reader

__all__ = ["Look", "look_of"]

_WHEELBASE = "base.wheelbase"


@dataclass(frozen=True)
class Look:
    """Names, units and sizes for drawing."""

    system: System
    latent_names: tuple[str, ...]
    latent_units: tuple[str, ...]
    action_low: tuple[float, ...]
    """(actions,) the filter's actuator limits."""
    action_high: tuple[float, ...]
    braking: Braking
    clearance: float
    """m kept to obstacles beyond the radius of the footprint."""
    wheelbase: float
    """m; 0 for a robot without wheels."""
    corridor_seconds: float
    """How far ahead the filter looks for a corridor."""
    wind: Callable[[Sequence[float]], Wind | None]
    """The wind that a latent stands for."""

    drawn: Callable[[StateMessage], Mapping[str, Shape]] | None = None
    """What a robot of one's own looks like; None: as this dashboard draws those that ship."""

    @property
    def is_planar(self) -> bool:
        """Whether the state begins with a position on the plane."""
        return self.system.state_names[:2] == ("x", "y")

    @property
    def h_unit(self) -> str:
        """Unit of the least barrier value, with a space before it; empty where it is the barriers' own choice."""
        return f" {self.system.state[0].unit}" if self.is_planar or self.is_pendulum else ""

    @property
    def is_point(self) -> bool:
        """Whether it is pushed along its heading and turned at a rate."""
        return self.system.action_names == ("thrust", "turn")

    @property
    def is_pendulum(self) -> bool:
        """Whether the state is an angle and its rate."""
        return self.system.state_names == ("angle", "rate")


def look_of(model: PhysicsModel, settings: FilterSettings) -> Look:
    """What model and filter settings say; limits that do not fit the model's action are left to the model."""
    actions = len(model.system.action)
    fits = len(settings.action_low) == actions
    wheelbase = model.settings.get(_WHEELBASE)
    return Look(
        system=model.system,
        latent_names=model.latent_names,
        latent_units=tuple(model.parameters[path].unit for path in model.latent_names),
        action_low=settings.action_low if fits else tuple(model.system.action_low.tolist()),
        action_high=settings.action_high if fits else tuple(model.system.action_high.tolist()),
        braking=Braking(settings.braking_deceleration, settings.braking_gain),
        clearance=settings.clearance,
        wheelbase=wheelbase.value if wheelbase else 0.0,
        corridor_seconds=settings.corridor_seconds,
        wind=wind_reader(model),
        drawn=_drawn(model),
    )


def _drawn(model: PhysicsModel) -> Callable[[StateMessage], Mapping[str, Shape]] | None:
    """The robot's own drawing, in which nothing that it raises ends the dashboard; None where it declares none."""
    robot = robot_like(model.system)
    if robot is None or type(robot).draw is AbstractRobot.draw:
        return None
    own = robot.draw

    def drawn(state: StateMessage) -> Mapping[str, Shape]:
        try:
            return own(state)
        except Exception:  # noqa: BLE001 - a user's own picture; without it the curves go on
            return {}

    return drawn
