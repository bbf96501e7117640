"""What the dashboard must know of a robot next to its messages: names, units, limits, size of the drawn body."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from safedpa.bus import StateMessage
from safedpa.drawing import Shape
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.robot import AbstractRobot, robot_like
from safedpa.safety.settings import FilterSettings
from safedpa.systems import System

__all__ = ["DisplaySettings", "display_settings", "wind_reader"]

Wind = tuple[float, float]
"""m/s towards positive angles, and upward."""

_ENTRIES: Final = ("wind.speed", "wind.upward")
_STEPS = 41
"""Winds per direction that the networks' latents are compared with: a quarter m/s apart at 5 m/s either way."""


def wind_reader(model: PhysicsModel) -> Callable[[Sequence[float]], Wind | None]:
    """What turns a latent (latents,) of the model into the wind that it stands for; None where it stands for none.

    Of physics, its free entries wind.speed and wind.upward, else the model's values. Of networks, the wind whose
    mu(e) is nearest to the latent, on a grid over the range of training.
    """
    if isinstance(model.base, LearnedBase):
        return _reader_of_networks(model.base)
    settings, names = model.settings, model.latent_names
    if not all(path in settings for path in _ENTRIES):
        return lambda _latent: None

    def read(latent: Sequence[float]) -> Wind | None:
        if len(latent) != len(names):
            return None
        across, up = (latent[names.index(path)] if path in names else settings[path].value for path in _ENTRIES)
        return across, up

    return read


def _reader_of_networks(base: LearnedBase) -> Callable[[Sequence[float]], Wind | None]:
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


_WHEELBASE = "base.wheelbase"


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
    """m kept to obstacles beyond the radius of the footprint."""
    wheelbase: float
    """m; 0 for a robot without wheels."""
    corridor_seconds: float
    """How far ahead the filter looks for a corridor."""
    wind: Callable[[Sequence[float]], Wind | None]
    """The wind that a latent stands for."""
    swept: Callable[[StateMessage], tuple[float, float, float] | None]
    """What the robot's barriers keep free along its heading now: rear end, front end and radius [m]; None: unknown."""

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


def display_settings(model: PhysicsModel, settings: FilterSettings) -> DisplaySettings:
    """What model and filter settings say; limits that do not fit the model's action are left to the model."""
    actions = len(model.system.action)
    fits = len(settings.action_low) == actions
    wheelbase = model.settings.get(_WHEELBASE)
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
        swept=_swept(model, settings),
        drawn=_drawn(model),
    )


def _swept(
    model: PhysicsModel, settings: FilterSettings
) -> Callable[[StateMessage], tuple[float, float, float] | None]:
    robot = robot_like(model.system)
    return (lambda state: None) if robot is None else (lambda state: robot.swept(state, settings))


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
