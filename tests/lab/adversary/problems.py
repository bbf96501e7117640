"""Small problems whose answer is known without a solver, and readers of what an attack reports."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np

from safedpa.safety import SafetyFilter
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row
from safedpa_lab.experiments.adversary.linear.problem import LinearProblem


def plane(*state: float, **changes: Any) -> LinearProblem:
    """x+ = x + a and h = x in two dimensions, a within [-1, 1], eta 0.5: the conditions are a >= -x / 2."""
    usual: dict[str, Any] = {
        "shape": "plane", "state": np.array(state), "f": np.array(state), "g": np.eye(2), "P": np.eye(2),
        "q": np.zeros(2), "low": -np.ones(2), "high": np.ones(2), "nominal": np.zeros(2), "weights": np.ones(2),
        "eta": 0.5, "epsilon": np.zeros(2), "gradient": True,
    }  # fmt: skip
    return LinearProblem(
        **{name: np.array(v) if isinstance(v, tuple | list) else v for name, v in (usual | changes).items()}
    )


def verdict(status: str, action: Sequence[float], h_next: float = 0.0) -> Any:
    """The part of a verdict that judges read."""
    return SimpleNamespace(status=SimpleNamespace(value=status), action=np.array(action), h_next=h_next, reason="")


def figures(rows: Sequence[Row], prefix: str = "") -> dict[str, tuple[float, int | None]]:
    """Each figure and the number of answers it was counted among, by its text without the prefix."""
    return {row.what.removeprefix(prefix): (row.measured, row.of) for row in rows if row.what.startswith(prefix)}


def found(attack: AbstractAttack, seed: int = 1) -> Result:
    """What the small attack finds."""
    return attack.reported([attack.work(piece) for piece in attack.pieces(seed, small=True)])


def measured(attack: AbstractAttack, seed: int = 1) -> dict[str, Row]:
    """Each figure of the small attack by its text."""
    return {row.what: row for row in found(attack, seed).rows}


def answer_with(patch: Any, status: str, action: Sequence[float]) -> None:
    """Makes every filter return this status and action until the patch is undone."""
    patch.setattr(SafetyFilter, "decide", lambda *_, **__: verdict(status, action))
