"""Drives that separate the pendulum's effects, which a diagnosis proposes."""

from __future__ import annotations

import numpy as np

from safedpa.arrays import FloatArray


def manoeuvres(t: FloatArray) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Returns releases, steps and sweeps of torque."""
    zero = np.zeros_like(t)
    found = {
        "release it from 90 degrees and let it swing out": (np.pi / 2, zero),
        "release it from 20 degrees next to hanging and let it swing out": (np.pi - 0.35, zero),
        "steps of torque, both ways": (np.pi, 1.0 * np.sign(np.sin(4 * t))),
        "hold a steady torque": (np.pi, 1.0 + zero),
        "sweep the torque slowly up and down": (np.pi, 1.5 * np.sin(t)),
    }
    return {text: (np.array([angle, 0.0]), torque[:, None]) for text, (angle, torque) in found.items()}
