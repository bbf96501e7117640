"""The model stage after stage: how the held-out error falls with every addition."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import Fit, fit
from safedpa.diagnosis.report_schema import DiagnosisStage, WorsenedState
from safedpa.diagnosis.search.forward_selection import SearchState
from safedpa.dynamics import PhysicsModel

__all__ = ["StageReport", "stages_of"]

_WORSE, _NOTHING = 0.05, 0.01
"""Share by which, and size from which, an error that grew is told."""

_Step = tuple[Fit, HeldoutError]


@dataclass(frozen=True)
class StageReport:
    """The stages, their models, and states that the last stage predicts worse in a run than the first does."""

    stages: list[DiagnosisStage]
    models: list[PhysicsModel]
    worse: tuple[WorsenedState, ...]


def stages_of(search: SearchState, heldout: Heldout, shown: Heldout) -> StageReport:
    """The given model refitted, then one stage per accepted effect that helps some run, refitted on the same windows.

    ``heldout`` has the search's own horizon, which gives the order; the errors are those of ``shown``. Effects stand
    in the order in which they were accepted. Where one helps only next to a later one, they are put in the order in
    which the error falls most, and ``search.added`` with them.
    """
    first = (search.first.fit, error_with(search.first.fit, search.shooting, heldout))
    steps = [first, *(_step(search, search.added[: count + 1], heldout) for count in range(len(search.added)))]
    if any(later[1].value > earlier[1].value for earlier, later in pairwise(steps)) and len(search.added) > 2:
        search.added, steps = _by_fall(search, first, heldout)
    names = heldout.windows.system.state_names
    errors = [error if shown is heldout else error_with(fitted, search.shooting, shown) for fitted, error in steps]
    retained = _that_help(errors)
    found = []
    for number, before in zip(retained, [None, *retained], strict=False):
        error = errors[number]
        per_state = {name: float(value) for name, value in zip(names, error.per_state, strict=True)}
        gain = _improved(None if before is None else errors[before], error)
        found.append(DiagnosisStage(tuple(search.added[:number]), error.value, per_state, gain))
    return StageReport(
        found, [steps[number][0].model for number in retained], _worse([errors[number] for number in retained], shown)
    )


def _that_help(errors: Sequence[HeldoutError]) -> list[int]:
    """The stages that predict some run better than the one before, the first and the last: what helps only next to a
    later effect is one stage with it."""
    retained = [0]
    for number in range(1, len(errors)):
        helps = (errors[number].by_run < errors[retained[-1]].by_run).any()
        if helps or number == len(errors) - 1:
            retained.append(number)
    return retained


def _worse(errors: Sequence[HeldoutError], shown: Heldout) -> tuple[WorsenedState, ...]:
    """What the mean over states and runs hides."""
    if len(errors) < 2:
        return ()
    before, after = errors[0].by_run_and_state, errors[-1].by_run_and_state
    with np.errstate(invalid="ignore"):
        rows, states = np.nonzero((after > (1.0 + _WORSE) * before) & (after > before + _NOTHING))
    names, runs = shown.windows.system.state_names, shown.windows.names
    found = [
        WorsenedState(len(errors) - 1, runs[row], names[state], float(before[row, state]), float(after[row, state]))
        for row, state in zip(rows.tolist(), states.tolist(), strict=True)
    ]
    return tuple(sorted(found, key=lambda item: item.before - item.after))


def _by_fall(search: SearchState, first: _Step, heldout: Heldout) -> tuple[list[str], list[_Step]]:
    """The accepted effects, at each step the one with which the error is lowest."""
    order: list[str] = []
    steps = [first]
    while len(order) < len(search.added):
        left = [name for name in search.added if name not in order]
        tried = {name: _step(search, [*order, name], heldout) for name in left}
        best = min(left, key=lambda name: tried[name][1].value)
        order.append(best)
        steps.append(tried[best])
    return order, steps


def _step(search: SearchState, names: Sequence[str], heldout: Heldout) -> _Step:
    """The first model with some of the accepted effects, refitted from the numbers of the last model."""
    if set(names) == set(search.added):
        return search.current.fit, error_with(search.current.fit, search.shooting, heldout)
    model, final = search.first.fit.model, search.current.fit.model
    for name in names:
        item = next(own for own in search.current.fit.model.effects if own.name == name)
        model = model.with_effect(item, {p.name: final.settings[f"{name}.{p.name}"] for p in item.parameters})
    own = [path for path in model.settings if path.split(".")[0] in names]
    found = fit(model, [*search.first.fit.paths, *own], search.shooting, search.current.fit.scale)
    return found, error_with(found, search.shooting, heldout)


def _improved(before: HeldoutError | None, after: HeldoutError) -> str:
    if before is None:
        return ""
    there = np.isfinite(before.by_run) & np.isfinite(after.by_run)
    return f"{int((after.by_run[there] < before.by_run[there]).sum())}/{int(there.sum())}"
