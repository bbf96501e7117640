"""Drives that separate the car's effects, which a diagnosis proposes."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray


def manoeuvres(t: FloatArray, throttle: bool) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Returns manoeuvres of a car; drive levels are shares of full throttle, or target speeds [m/s]."""
    slow, fast = (0.2, 0.5) if throttle else (0.8, 2.0)
    zero = np.zeros_like(t)
    found = {
        "coast down: drive straight at speed, then release the drive": (2.0, zero, zero),
        "drive straight at a slow steady speed, then at a fast one": (0.0, np.where(t < 3, slow, fast), zero),
        "drive straight, in steps up and down": (0.5, np.where(np.sin(4 * t) > 0, fast, slow), zero),
        "hold a steady curve, slow and then fast": (0.5, np.where(t < 3, slow, fast), 0.25 + zero),
        "hold a curve to the left, then the same to the right": (1.0, fast + zero, np.where(t < 3, 0.2, -0.2)),
        "steer in steps, left and right, at speed": (1.5, fast + zero, 0.2 * np.sign(np.sin(5 * t))),
        "steer fully to the stops, slowly": (0.5, slow + zero, 0.34 * np.clip(t / 3, -1, 1)),
    }
    with_start = {}
    for text, (speed, drive, steer) in found.items():
        with_start[text] = (np.array([0.0, 0.0, 0.0, speed]), np.stack([drive, steer], axis=1))
    opposite = np.array([0.0, 0.0, np.pi, 1.0])
    with_start["drive the same straight line in the opposite heading"] = (
        opposite,
        np.stack([fast + zero, zero], axis=1),
    )
    return with_start
