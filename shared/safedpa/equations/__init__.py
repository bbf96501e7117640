"""Equations over ``Operations``, written down once: values, slopes and batches from the same lines."""

from safedpa.equations.given import Given
from safedpa.equations.tape import NotStraightError

__all__ = ["Given", "NotStraightError"]
