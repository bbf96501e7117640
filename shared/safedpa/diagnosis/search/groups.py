"""Second thoughts about two effects at once: with fewer numbers as good, or two in the place of one far better.

Source: Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3 (exchanges of more than one at a time).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

from safedpa.diagnosis.fit.heldout import Heldout, error_with
from safedpa.diagnosis.fit.trial import Trial, block_gain
from safedpa.diagnosis.search.judgement import passes
from safedpa.diagnosis.search.progress import Search, known_effects
from safedpa.diagnosis.search.revision import HOPELESS, as_good, refit, replaced
from safedpa.effects import AbstractEffect

__all__ = ["fewer_numbers", "split"]

_RIVALS = 4
"""Rivals of each accepted effect that are looked at."""


def fewer_numbers(search: Search, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """One or two accepted effects give way to as many of their rivals that predict as well with fewer numbers.

    A rival that says the same with a number less was beaten by rounding, or because the others were not there yet: a
    towed load whose resistance is none is a payload.
    """
    by_name = known_effects(search, library)
    while True:
        found = []
        for group in [group for count in (1, 2) for group in combinations(search.added, count)]:
            best = _best(search, group, _with_fewer(search, group, by_name), by_name)
            if best is not None and as_good(best[0], search, heldout):
                found.append((group, *best))
        if not found:
            return
        group, trial, names = min(found, key=lambda one: one[1].loss)
        replaced(search, group, names, trial, heldout)


def split(search: Search, library: Sequence[AbstractEffect], heldout: Heldout) -> None:
    """An accepted effect gives way to two of its rivals that pass beside the others in its place: a delay of all
    actuators stood for a lag of each."""
    by_name = known_effects(search, library)
    for name in list(search.added):
        names = [other for other in search.rivals.get(name, [])[:_RIVALS] if other not in search.added]
        best = _best(search, (name,), list(combinations(names, 2)), by_name)
        if best is None:
            continue
        gain = block_gain(search.current, best[0], search.shooting)
        error = error_with(best[0].fit, search.shooting, heldout)
        if best[0].fit.free.all() and passes(gain, error, search.error):
            replaced(search, (name,), best[1], best[0], heldout)


def _with_fewer(search: Search, group: Sequence[str], by_name: Mapping[str, AbstractEffect]) -> list[tuple[str, ...]]:
    """As many rivals of some effects, with fewer numbers together."""
    numbers = sum(len(by_name[name].parameters) for name in group)
    rivals = dict.fromkeys(rival for name in group for rival in search.rivals.get(name, [])[:_RIVALS])
    names = [name for name in rivals if name not in search.added]
    found = combinations(names, len(group))
    return [one for one in found if sum(len(by_name[name].parameters) for name in one) < numbers]


def _best(
    search: Search,
    group: Sequence[str],
    instead: Sequence[tuple[str, ...]],
    by_name: Mapping[str, AbstractEffect],
) -> tuple[Trial, tuple[str, ...]] | None:
    """Which of some effects fits best in the place of others, beside the rest; None where none comes near."""
    rest = [by_name[name] for name in search.added if name not in group]
    enough = search.current.fit.value + HOPELESS
    tried = [(refit(search, [*rest, *map(by_name.__getitem__, names)], enough), names) for names in instead]
    near = [(trial, names) for trial, names in tried if trial.fit.value <= enough]
    return min(near, key=lambda pair: pair[0].loss, default=None)
