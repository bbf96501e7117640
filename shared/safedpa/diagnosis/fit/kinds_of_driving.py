"""What a fitted number differs by between kinds of driving: slow and fast, straight and in curves, steady and changing.

A model of the right form has the same numbers in all of them, but for chance. One that is wrong in form has not, and
stretches of time, each with every kind of driving in it, agree on a wrong number: only kinds of driving show it.

Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, ch. 11 (jackknife), over groups of like windows.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from safedpa.compare.where import PLACE
from safedpa.compare.windows import Floats
from safedpa.diagnosis.fit.least_squares import Fit, jackknife, products_of
from safedpa.diagnosis.fit.shooting import Shooting

__all__ = ["between_kinds"]

_GROUPS = 8
"""Of as many windows each."""
_FEWEST = 3
"""Windows in a group."""
_CHANCE = 2.0
"""Times the deviation over blocks that groups give by chance at most: once in 5000 for 8 groups (F distribution)."""


def between_kinds(fitted: Fit, shooting: Shooting) -> Floats:
    """The largest standard deviation (paths,) by what each group of like windows moves; 0 where chance would do.

    Windows are put in order by the mean size of each state and action, and by how much each action varies.
    """
    found = np.zeros(len(fitted.paths))
    if not fitted.free.any() or len(shooting.windows) < _GROUPS * _FEWEST:
        return found
    products, slopes = products_of(fitted.columns[..., fitted.free], fitted.residual)
    blocks = jackknife(products, slopes, shooting.block)
    largest = np.zeros(len(blocks))
    for kind in _kinds(shooting):
        place = np.argsort(np.argsort(kind, kind="stable"), kind="stable")
        largest = np.maximum(largest, jackknife(products, slopes, place * _GROUPS // len(place)))
    found[fitted.free] = np.sqrt(np.where(largest > _CHANCE**2 * blocks, largest, 0.0))
    return found


def _kinds(shooting: Shooting) -> Iterator[Floats]:
    """What windows are put in order by, (windows,) each; nothing that hardly varies."""
    windows = shooting.windows
    rows = np.minimum(windows.start[:, None] + shooting.rows, windows.end[:, None] - 1)
    actions = windows.actions[rows]
    moving = [index for index, variable in enumerate(windows.system.state) if variable.name not in PLACE]
    for values in (
        np.abs(windows.states[rows][..., moving]).mean(axis=1),
        np.abs(actions).mean(axis=1),
        actions.std(axis=1),
    ):
        yield from (column for column in values.T if np.ptp(column) > 0.0)
