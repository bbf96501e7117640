"""The wind that a latent stands for, so that it can be drawn as an arrow."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from safedpa.dynamics import LearnedBase, PhysicsModel

__all__ = ["Wind", "wind_reader"]

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
