"""A place where the floor brakes: no effect of the library, but what an engineer would look for on the map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from safedpa.compare.where import PLACE
from safedpa.compare.windows import Floats
from safedpa.diagnosis.fit.pushes import pushes_of
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial, block_gain, tried, with_start
from safedpa.diagnosis.search.places import Circle, Place, Strip

__all__ = ["Patch", "best_patch", "capped", "in_one_room"]

_SURE = 2.0
"""Standard errors of gain on unseen blocks: few blocks lie in one place, so they are never many."""
_AHEAD = 2.0
"""Standard errors by which it has to be better than the best effect of the library."""
_LITTLE = 0.03
"""Fall of the logarithm of the held-out residual, mean over the states, that is worth a place."""
_FEWEST = 8
"""Windows inside."""
_FEWEST_OF_A_RUN = 3
_TOUCHED = 0.01
"""Of the most that a place explains in a window, from which a window counts as inside."""
_MOST = 0.7
"""Share of the windows inside: what is nearly everywhere is no place."""


@dataclass(frozen=True)
class Patch:
    """The place that explains most, fitted like an effect."""

    place: Place
    trial: Trial
    gain: float
    share: float
    """Of the remaining squared error."""

    @property
    def values(self) -> dict[str, float]:
        """Its parameters by name, SI."""
        settings = self.trial.fit.model.settings
        return {p.name: settings[f"{self.place.name}.{p.name}"].value for p in self.place.parameters}

    @property
    def expression(self) -> str:
        """The formula in one line."""
        values = self.values
        size = values["deceleration"]
        sign = "-" if size > 0 else "+"
        return f"d(speed)/dt {sign}= {abs(size):.2g} sign(speed) where {self.place.where(values)}"

    def beats(self, effect: Trial, shooting: Shooting) -> bool:
        """Whether it predicts unseen blocks clearly better than an effect of the library."""
        return self.trial.loss < effect.loss - _LITTLE and block_gain(effect, self.trial, shooting) > _AHEAD


def capped(pushes: Floats) -> Floats:
    """Pushes (windows, ...) cut at what glitches alone exceed.

    Six medians or the 90 % quantile of the sizes, whichever is larger: where a fifth of the windows is pushed hard and
    the rest not at all, the median knows nothing of the hard ones.
    """
    size = np.abs(pushes)
    most = np.maximum(6.0 * np.median(size, axis=0), np.quantile(size, 0.9, axis=0)) + 1e-9
    return np.clip(pushes, -most, most)


def best_patch(null: Trial, shooting: Shooting) -> Patch | None:
    """The best circle or strip, or None where there is no plane or no place that unseen blocks confirm."""
    names = shooting.windows.system.state_names
    if not {*PLACE, "speed"} <= set(names) or len(shooting.windows) < 30 or not in_one_room(shooting):
        return None
    middle = shooting.measured[:, shooting.measured.shape[1] // 2]
    points, signs = middle[:, [names.index(name) for name in PLACE]], np.sign(middle[:, names.index("speed")])
    along = capped(pushes_of(null, shooting, ("speed",))[:, 0]) * signs
    robot = shooting.windows.system.name
    shapes = [(item, _start(item, points, along)) for item in (Circle(robot), Strip(robot))]
    found = [_fitted(item, start, null, shooting) for item, start in shapes if start]
    kept = [
        patch
        for patch in found
        if patch.gain >= _SURE and patch.trial.loss <= null.loss - _LITTLE and _in_most_runs(patch, null, shooting)
    ]
    return min(kept, key=lambda patch: patch.trial.loss, default=None)


def in_one_room(shooting: Shooting) -> bool:
    """Whether the runs may be of one room: the places where they were overlap, directly or by way of other runs."""
    windows = shooting.windows
    at = [windows.system.state_names.index(name) for name in PLACE]
    points = shooting.measured[:, shooting.measured.shape[1] // 2][:, at]
    boxes = [np.quantile(points[windows.run == run], [0.02, 0.98], axis=0) for run in np.unique(windows.run)]
    reached, left = boxes[:1], boxes[1:]
    while left:
        near = [box for box in left if any(_overlap(box, other) for other in reached)]
        if not near:
            return False
        reached, left = [*reached, *near], [box for box in left if not any(box is one for one in near)]
    return True


def _overlap(one: Floats, other: Floats) -> bool:
    return bool((one[0] <= other[1]).all() and (other[0] <= one[1]).all())


def _in_most_runs(patch: Patch, null: Trial, shooting: Shooting) -> bool:
    """Whether most of the runs that were in the place are predicted better with it: a floor is the same for all."""
    inside = (patch.trial.explained**2).sum(axis=1) > _TOUCHED * float((patch.trial.explained**2).sum(axis=1).max())
    better = ((null.heldout - patch.trial.heldout) / null.fit.scale**2).sum(axis=1)
    runs = shooting.windows.run
    there = [run for run in np.unique(runs) if int((inside & (runs == run)).sum()) >= _FEWEST_OF_A_RUN]
    return sum(float(better[inside & (runs == run)].sum()) > 0 for run in there) > 0.5 * len(there) or not there


def _fitted(item: Place, start: dict[str, float], null: Trial, shooting: Shooting) -> Patch:
    trial = tried(null, [item], shooting, [with_start(null.fit.model, item, start)])
    ratio = (trial.heldout.sum(axis=0) / null.heldout.sum(axis=0)).mean()
    return Patch(item, trial, block_gain(null, trial, shooting), float(1.0 - ratio))


def _start(item: Place, points: Floats, along: Floats) -> dict[str, float] | None:
    """The place and deceleration that explain most of the pushes along the motion (windows,)."""
    best, found = 0.0, None
    for place, inside in item.starts(points):
        count = int(inside.sum())
        if not _FEWEST <= count <= _MOST * len(points):
            continue
        size = float(along[inside].sum()) / count
        if size * size * count > best:
            best = size * size * count
            found = {**place, "deceleration": float(np.clip(-size, -9.0, 9.0))}
    return found
