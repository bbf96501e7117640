"""What the dashboard needs besides messages: names, units, limits and sizes, from model and filter settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from safedpa.bus import StateMessage
from safedpa.drawing import Shape
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.robot import AbstractRobot
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System
from safedpa.systems.robots import Robot, robot_like

Wind = tuple[float, float]
"""Wind in m/s towards positive angles, and upward."""

_ENTRIES: Final = ("wind.speed", "wind.upward")
_STEPS = 41
"""Grid points per direction for inverting the encoder: 0.25 m/s apart for a training range of 5 m/s either way."""


def wind_reader(model: PhysicsModel) -> Callable[[Sequence[float]], Wind | None]:
    """Returns a function that converts a latent (latents,) of the model to the wind it represents, or to None.

    For a physics model, the wind is read from the latent entries wind.speed and wind.upward, or from the model's
    values. For networks, it is the wind whose encoding mu(e) is nearest to the latent, on a grid over the training
    range.
    """
    if isinstance(model.base, LearnedBase):
        return _learned_wind_reader(model.base)
    settings, names = model.settings, model.latent_names
    if not all(path in settings for path in _ENTRIES):
        return lambda _latent: None

    def read(latent: Sequence[float]) -> Wind | None:
        if len(latent) != len(names):
            return None
        across, up = (latent[names.index(path)] if path in names else settings[path].value for path in _ENTRIES)
        return across, up

    return read


def _learned_wind_reader(base: LearnedBase) -> Callable[[Sequence[float]], Wind | None]:
    described = base.weights.description
    entries = [(entry.path, entry.low, entry.high) for entry in described.environment]
    if tuple(path for path, _, _ in entries) != _ENTRIES or not described.latents:
        return lambda _latent: None
    axes = [np.linspace(low, high, _STEPS) for _, low, high in entries]
    winds = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    known = base.networks.encode(winds)

    def read(latent: Sequence[float]) -> Wind | None:
        if len(latent) < described.latents or not np.isfinite(latent).all():
            return None
        across, up = winds[np.square(known - np.array(latent[: described.latents])).sum(axis=1).argmin()].tolist()
        return across, up

    return read


@dataclass(frozen=True)
class DisplaySettings:
    """Names, units and sizes for drawing."""

    system: System
    latent_names: tuple[str, ...]
    latent_units: tuple[str, ...]
    action_low: tuple[float, ...]
    """(actions,) the filter's actuator limits."""
    action_high: tuple[float, ...]
    clearance: float
    """Distance kept to obstacles beyond the radius of the footprint [m]."""
    wheelbase: float
    """Wheelbase [m]; 0 for a robot without wheels."""
    corridor_seconds: float
    """Look-ahead time of the corridor's barrier [s]."""
    wind: Callable[[Sequence[float]], Wind | None]
    """Converts a latent to a wind."""
    swept: Callable[[StateMessage], tuple[float, float, float] | None]
    """Area along the heading that the barriers keep free: rear end, front end and radius [m]; None: unknown."""

    drawn: Callable[[StateMessage], Mapping[str, Shape]] | None = None
    """Drawing of a user's own robot; None: drawn as the shipped robots."""

    @property
    def is_planar(self) -> bool:
        """Whether the state begins with a position on the plane."""
        return self.system.state_names[:2] == ("x", "y")

    @property
    def h_unit(self) -> str:
        """Unit of the smallest h, with a leading space; empty if the barriers have different units."""
        return f" {self.system.state[0].unit}" if self.is_planar or self.is_pendulum else ""

    @property
    def is_point(self) -> bool:
        """Whether the robot has a thrust along its heading and a turn rate."""
        return self.system.action_names == ("thrust", "turn")

    @property
    def is_pendulum(self) -> bool:
        """Whether the state is an angle and its rate."""
        return self.system.state_names == ("angle", "rate")


def display_settings(model: PhysicsModel, settings: FilterSettings) -> DisplaySettings:
    """Returns the display settings; the model's action limits are used if those of the filter do not fit the model."""
    robot, wheelbase = robot_like(model.system), model.settings.get("base.wheelbase")
    fits = len(settings.action_low) == len(model.system.action)
    return DisplaySettings(
        system=model.system,
        latent_names=model.latent_names,
        latent_units=tuple(model.parameters[path].unit for path in model.latent_names),
        action_low=settings.action_low if fits else tuple(model.system.action_low.tolist()),
        action_high=settings.action_high if fits else tuple(model.system.action_high.tolist()),
        clearance=settings.barriers.get("clearance", 0.0),
        wheelbase=wheelbase.value if wheelbase else 0.0,
        corridor_seconds=settings.barriers.get("corridor_seconds", 0.0),
        wind=wind_reader(model),
        swept=(lambda _state: None) if robot is None else (lambda state: robot.swept(state, settings)),
        drawn=_drawn(robot),
    )


def _drawn(robot: Robot | None) -> Callable[[StateMessage], Mapping[str, Shape]] | None:
    """Returns the drawing function of a user's own robot, whose errors are ignored; None if it declares none."""
    if robot is None or type(robot).draw is AbstractRobot.draw:
        return None
    own: Callable[[StateMessage], Mapping[str, Shape]] = robot.draw

    def drawn(state: StateMessage) -> Mapping[str, Shape]:
        try:
            return own(state)
        except Exception:  # noqa: BLE001 - user code; the curves are shown without the drawing
            return {}

    return drawn
