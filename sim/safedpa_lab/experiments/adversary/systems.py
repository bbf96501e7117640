"""Attack: small control systems under hostile nominal actions, each answer compared with a grid of actions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.safety import Verdict
from safedpa_lab.experiments.adversary.attack import (
    BROKEN,
    AbstractAttack,
    Answers,
    Judged,
    Result,
    Row,
    action_grid,
    notice_of,
)
from safedpa_lab.experiments.adversary.example_systems import (
    ControlSystem,
    adaptive_cruise,
    chased,
    corridor,
    disc_by_higher_order,
    disc_by_rollout,
    disc_of_degree_two,
    double_integrator,
    late_by_pending_actions,
    late_drive,
    pendulum,
    quadrotor,
    thin_disc,
    unicycle,
)

NominalPolicy = Callable[[FloatArray], FloatArray]

_HELD: Final = 8
"""Periods for which an adversary holds its nominal action in its mind."""
_LEG: Final = 12
"""Periods between two changes of a bang-bang nominal action."""


def _towards(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    """The corner of the box that brings the least h down furthest if it is held for a while."""
    corners = _corners(system)

    def lowest(state: FloatArray, corner: FloatArray) -> float:
        least, at = float("inf"), state
        for _ in range(_HELD):
            reached = system.after(at, corner[None])[0]
            least, at = min(least, system.least_on_the_way(at, reached)), reached
        return least

    def nominal_action(state: FloatArray) -> FloatArray:
        then = np.array([lowest(state, corner) for corner in corners])
        return np.asarray(corners[int(np.argmin(then + 1e-12 * random.uniform(size=len(then))))])

    return nominal_action


def _anything(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    low, high = np.array(system.low), np.array(system.high)
    return lambda _: random.uniform(low - 0.5 * (high - low), high + 0.5 * (high - low))


def _bang_bang(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    def legs() -> Iterator[FloatArray]:
        corners = _corners(system)
        while True:
            yield from [corners[int(random.integers(len(corners)))]] * _LEG

    held = legs()
    return lambda _: next(held)


def _broken(system: ControlSystem, random: np.random.Generator) -> NominalPolicy:
    """Towards the obstacle, and NaN or infinity in every tenth period."""
    towards = _towards(system, random)

    def nominal_action(state: FloatArray) -> FloatArray:
        wanted = towards(state).copy()
        if random.uniform() < 0.1:
            wanted[int(random.integers(len(wanted)))] = random.choice([np.nan, np.inf, -np.inf])
        return wanted

    return nominal_action


def _corners(system: ControlSystem) -> FloatArray:
    return action_grid(system.low, system.high, [2] * len(system.low))


NOMINAL_POLICIES: Final[dict[str, Callable[[ControlSystem, np.random.Generator], NominalPolicy]]] = {
    "towards": _towards,
    "random": _anything,
    "bang-bang": _bang_bang,
    "NaN now and then": _broken,
}
"""By name; episode n has the (n modulo their number)-th."""


SYSTEMS: Final[tuple[Callable[[], ControlSystem], ...]] = (
    double_integrator,
    unicycle,
    pendulum,
    quadrotor,
    adaptive_cruise,
    chased,
    corridor,
    partial(late_drive, looking_ahead=False),
    partial(late_drive, looking_ahead=True),
    late_by_pending_actions,
    disc_of_degree_two,
    disc_by_rollout,
    disc_by_higher_order,
    partial(thin_disc, between_ticks=False),
    partial(thin_disc, between_ticks=True),
)

_FULL: Final = (40, 150)
"""Episodes of each system, and periods of each."""
_SMALL: Final = (4, 60)
_EVERY: Final = {False: 1, True: 5}
"""Periods between two evaluations of the grid; rollout barriers are slow to evaluate."""


@final
@dataclass
class Tally:
    """What became of some episodes of one system."""

    statuses: Counter[str] = field(default_factory=Counter)
    least_h: float = float("inf")
    """In truth, over all periods."""
    crashed: int = 0
    """Episodes with h < 0 in truth."""
    episodes: int = 0
    answers: list[Judged] = field(default_factory=list)
    """Those that were compared with the grid."""

    def add(self, other: Tally) -> None:
        """Takes another one's figures in."""
        self.statuses.update(other.statuses)
        self.least_h = min(self.least_h, other.least_h)
        self.crashed, self.episodes = self.crashed + other.crashed, self.episodes + other.episodes
        self.answers += other.answers


@final
class Systems(AbstractAttack):
    """True least h, and better actions of the grid. The model is exact: every failure is the filter's."""

    name = "systems"
    sentence = "nine small systems under hostile nominal actions, against grids of actions"

    def pieces(self, seed: int, small: bool) -> Sequence[Any]:  # noqa: D102
        episodes, steps = _SMALL if small else _FULL
        return [(seed, index, episode, steps) for index in range(len(SYSTEMS)) for episode in range(episodes)]

    def work(self, piece: Any) -> tuple[int, Tally]:  # noqa: D102
        seed, index, episode, steps = piece
        return index, _episode(SYSTEMS[index](), np.random.default_rng([seed, 4, index, episode]), episode, steps)

    def reported(self, answers: Sequence[Any]) -> Result:  # noqa: D102
        rows: list[Row] = []
        for index, make in enumerate(SYSTEMS):
            tally = Tally()
            for own, one in answers:
                if own == index:
                    tally.add(one)
            rows += _rows(make(), tally)
        return Result(rows)


def _episode(system: ControlSystem, random: np.random.Generator, number: int, steps: int) -> Tally:
    """Every other four episodes without a margin; there the rounding of the last digit decides."""
    kind = tuple(NOMINAL_POLICIES)[number % len(NOMINAL_POLICIES)]
    margin = system.margin if (number // len(NOMINAL_POLICIES)) % 2 == 0 or kind.startswith("NaN") else 0.0
    safe, nominal, tally = system.filter(margin), NOMINAL_POLICIES[kind](system, random), Tally(episodes=1)
    grid, state = _grid(system), _safe_start(system, random)
    for step in range(steps):
        wanted = nominal(state)
        verdict = safe.decide(state, nominal=wanted)
        tally.statuses[verdict.status.value] += 1
        if step % _EVERY[system.barriers is not None] == 0:
            tally.answers += _judged(system, margin, grid, state, wanted, verdict)
        reached = system.after(state, verdict.action[None])[0]
        tally.least_h = min(tally.least_h, system.least_on_the_way(state, reached))
        state = reached
    tally.crashed = int(tally.least_h < 0.0)
    return tally


def _judged(
    system: ControlSystem, margin: float, grid: FloatArray, state: FloatArray, nominal: FloatArray, verdict: Verdict
) -> list[Judged]:
    """One answer next to the grid, by the barriers that the filter was given; none of a nominal action without a number
    that nothing keeps."""
    action, status, finite = verdict.action, verdict.status.value, bool(np.isfinite(nominal).all())
    now = system.heights(state[None])[0]
    required, scale = (1.0 - system.eta) * now + margin, np.maximum(np.abs(now), margin)
    own = system.heights(system.after(state, action[None]), since=state)[0]
    feasible, h = np.zeros(len(grid), dtype=bool), None
    if status != "passed":
        h = system.heights(system.after(state, grid), since=state)
        scale = np.maximum(scale, h.max(axis=0) - h.min(axis=0))
        feasible = ((h - required) / scale >= BROKEN).all(axis=1)
    if status in ("passed", "corrected"):
        broken = max(0.0, -float(((own - required) / np.maximum(scale, 1e-12)).min()))
        excess = None
        if feasible.any() and finite:
            excess = float(_far(system, action[None], nominal)[0] - _far(system, grid[feasible], nominal).min())
        return [Judged(status=status, broken=broken, below=bool(own.min() < -1e-15), excess=excess)]
    assert h is not None
    missed = bool(feasible.any()) and status != "violated"
    needless = bool((own / scale < -BROKEN).any()) and bool((h >= 0.0).all(axis=1).any())
    return [Judged(status=status, missed=missed, needless=needless)] if finite else []


def _far(system: ControlSystem, actions: FloatArray, nominal: FloatArray) -> FloatArray:
    width = np.array(system.high) - np.array(system.low)
    return np.asarray(np.sqrt((((actions - nominal) / width) ** 2).sum(axis=1)))


def _grid(system: ControlSystem) -> FloatArray:
    fine = system.barriers is None
    count = (401 if fine else 41) if len(system.low) == 1 else (31 if fine else 9)
    return action_grid(system.low, system.high, [count] * len(system.low))


def _safe_start(system: ControlSystem, random: np.random.Generator) -> FloatArray:
    while True:
        state = system.start(random)
        if min(system.heights(state[None]).min(), system.h(state[None]).min()) > 0.05:
            return state


def _rows(system: ControlSystem, tally: Tally) -> list[Row]:
    name, found = system.name, Answers(tally.answers)
    asked, kept = -1e-9 if system.invariant else None, len(found.broken)
    needless = f"{name}: h < 0 predicted, though the grid keeps h >= 0"
    return [
        Row(f"{name}: least h in truth ({notice_of(tally.statuses)})", tally.least_h, tally.episodes, least=asked),
        Row(f"{name}: episodes with h < 0", tally.crashed, tally.episodes),
        Row(f"{name}: largest break, in scales", max(found.broken, default=0.0), kept, most=BROKEN),
        Row(f"{name}: passed or corrected, predicted h < 0", found.count("below"), kept, most=0),
        Row(f"{name}: relaxed, though the grid keeps all", found.count("missed"), found.rest, most=0),
        Row(needless, found.count("needless"), found.rest, most=0),
        found.too_far(name, 0.5),
    ]
