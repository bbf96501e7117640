"""What the quadratic program answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

__all__ = ["Solution"]


@final
class Solution:
    """Minimiser ``action`` (actions,), its ``slack`` (m,) in the conditions' units, and the solver's word, ``status``.

    ``solved`` is False when the solver did not vouch for it: then it must not be used.
    """

    def __init__(self, action: Sequence[float], slack: Sequence[float], solved: bool, status: str) -> None:
        self.action, self.slack, self.solved, self.status = action, slack, solved, status
