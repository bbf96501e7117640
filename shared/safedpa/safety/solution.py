"""What the quadratic program answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

__all__ = ["Solution"]


@final
@dataclass(frozen=True, eq=False)
class Solution:
    """Minimiser; ``solved`` is False when the solver did not vouch for it: then it must not be used."""

    action: Sequence[float]
    """(actions,)."""
    slack: Sequence[float]
    """(m,) in the conditions' units."""
    solved: bool
    status: str
