"""Attack: the example of the safety page, with h, states and actions in other units."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter
from safedpa_lab.experiments.adversary.attack import AbstractAttack, Result, Row

_STEPS: Final = 400
_WALL: Final = 1.0
_SAME: Final = 1e-6
"""Share of the range within which two actions are the same."""
_GRID: Final = 20_001


@final
@dataclass(frozen=True)
class Units:
    """Factors of h, position, speed and action; ``offset`` is added to the position, in its unit."""

    h: float = 1.0
    position: float = 1.0
    speed: float = 1.0
    action: float = 1.0
    offset: float = 0.0
    gradient: bool = False
    what: str = "h"


@final
@dataclass(frozen=True)
class Drive:
    """In the units of the page: statuses, actions (steps,), and the furthest point."""

    statuses: tuple[str, ...]
    actions: tuple[float, ...]
    furthest: float
    worst: float
    """Largest distance of an action from the nearest that the grid allows; infinite where the grid allows none."""


def drive(units: Units) -> Drive:
    """The mass on a line is requested towards the wall, 400 steps from rest."""
    safe = _filter(units)
    x, v = 0.0, 0.0
    statuses, actions, furthest, worst = [], [], 0.0, 0.0
    for _ in range(_STEPS):
        state = np.array([x * units.position + units.offset, v * units.speed])
        verdict = safe.decide(state, nominal=[units.action])
        statuses.append(verdict.status.value)
        actions.append(float(verdict.action[0]) / units.action)
        worst = max(worst, abs(actions[-1] - _allowed(x, v)))
        x, v = x + 0.05 * v + 0.00125 * actions[-1], v + 0.05 * actions[-1]
        furthest = max(furthest, x)
    return Drive(tuple(statuses), tuple(actions), furthest, worst)


@final
class Scales(AbstractAttack):
    """The same drive in other units is the same drive."""

    name = "scales"
    sentence = "the safety page's example with h, states and actions in other units"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        random = np.random.default_rng([seed, 2])
        powers = range(-12, 13, 8 if small else 1)
        made = [Units(h=10.0**power, gradient=gradient) for power in powers for gradient in (False, True)]
        for power in range(-6, 7, 6 if small else 2):
            unit = 10.0**power
            made += [Units(position=unit, what="state"), Units(speed=unit, what="state")]
            made += [Units(position=unit, speed=unit, what="state"), Units(action=unit, what="action")]
        for _ in range(2 if small else 40):
            h, position, speed, action = 10.0 ** random.uniform((-12, -6, -6, -6), (12, 6, 6, 6))
            made.append(Units(h, position, speed, action, what="all", gradient=bool(random.integers(2))))
        for offset in (1e3,) if small else (1e2, 1e4, 1e6, 1e8):
            made.append(Units(offset=offset, what="origin"))
        return made

    def work(self, piece: Any) -> tuple[Units, Drive]:  # noqa: D102
        return piece, drive(piece)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        reference = drive(Units())
        rows = [
            Row("furthest point at scale 1", reference.furthest, 1, most=_WALL, unit="m"),
            Row("furthest from the grid's action, in ranges", 0.5 * reference.worst, _STEPS, most=0.1),
        ]
        worst: list[dict[str, Any]] = []
        for what in ("h", "state", "action", "all", "origin"):
            found = [(units, driven) for units, driven in answers if units.what == what]
            rows += _rows(what, [driven for _, driven in found], reference)
            worst += [
                {"fault": f"other {what}", "units": units.__dict__, "furthest": driven.furthest}
                for units, driven in found
                if driven.furthest > _WALL or driven.statuses != reference.statuses
            ]
        return Result(rows, worst)


def _rows(what: str, found: Sequence[Drive], reference: Drive) -> list[Row]:
    """With a moved origin, h itself has fewer digits: only the wall is checked there."""
    strict = None if what == "origin" else 0
    changes = (np.abs(np.subtract(driven.actions, reference.actions)).max() for driven in found)
    apart = float(max(changes, default=0.0)) / 2.0
    others = sum(driven.statuses != reference.statuses for driven in found)
    return [
        Row(f"{what}: furthest point", max((driven.furthest for driven in found), default=0.0), len(found), most=_WALL),
        Row(f"{what}: drives with other statuses", others, len(found), most=strict),
        Row(
            f"{what}: largest change of an action, in ranges", apart, len(found), most=None if strict is None else _SAME
        ),
    ]


def _filter(units: Units) -> SafetyFilter:
    wall = _WALL * units.position + units.offset

    def h(x: Any) -> float:
        v = max(x[1] / units.speed, 0.0)
        return float(units.h * ((wall - x[0]) / units.position - v * v / 1.6 - 0.1 * v))

    def gradient(x: Any) -> Any:
        v = max(x[1] / units.speed, 0.0)
        return np.array([-units.h / units.position, -units.h * (v / 0.8 + 0.1 * (v > 0.0)) / units.speed])

    def affine(x: Any) -> Any:
        f = np.array([x[0] + 0.05 * x[1] * units.position / units.speed, x[1]])
        return f, np.array([[0.00125 * units.position], [0.05 * units.speed]]) / units.action

    settings = FilterSettings(
        action_low=(-units.action,),
        action_high=(units.action,),
        backup_action=(-units.action,),
        eta=0.1,
        epsilon=0.002 * units.h,  # type: ignore[arg-type]
    )
    return SafetyFilter(affine, [FunctionBarrier(h, gradient if units.gradient else None)], settings)


def _allowed(x: float, v: float) -> float:
    """The largest action of a grid that satisfies the condition; the lowest where none does."""

    def h(p: Any, s: Any) -> Any:
        return _WALL - p - np.maximum(s, 0.0) ** 2 / 1.6 - 0.1 * np.maximum(s, 0.0)

    actions = np.linspace(-1.0, 1.0, _GRID)
    kept = h(x + 0.05 * v + 0.00125 * actions, v + 0.05 * actions) >= 0.9 * h(x, v) + 0.002
    return float(actions[kept].max()) if kept.any() else -1.0
