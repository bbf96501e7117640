"""What one period brought to each of many robots that practise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

__all__ = ["Moved"]

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]


@final
@dataclass(frozen=True)
class Moved:
    """Arrays (robots,); an episode ends where ``reached`` or ``timed_out``."""

    reward: Floats
    reached: Flags
    timed_out: Flags
    contact: Flags
    """What must not be is going on: something is touched, a hazard is entered."""
    began: Flags
    """Contacts that began in this tick."""
