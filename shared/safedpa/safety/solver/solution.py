"""The result of the quadratic program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

__all__ = ["Solution"]


@final
class Solution:
    """Minimiser ``action`` (actions,), its ``slack`` (m,) in the units of the constraints, and the solver's ``status``.

    ``solved`` is False if the solver did not converge: the action must then not be used.
    """

    def __init__(self, action: Sequence[float], slack: Sequence[float], solved: bool, status: str) -> None:
        self.action, self.slack, self.solved, self.status = action, slack, solved, status
