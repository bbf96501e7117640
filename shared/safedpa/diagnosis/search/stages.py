"""Stages of the report: how the held-out error falls with every added effect."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from safedpa.diagnosis.fit.cross_validation import Heldout, HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import Fit, fit
from safedpa.diagnosis.report_schema import DiagnosisStage, WorsenedState
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.dynamics import PhysicsModel

# An error of a state is reported as worse if it grew by 5 % of itself and by 1 % of the state's usual change: less is
# within the scatter of a held-out error.
_RELATIVE_INCREASE, _ABSOLUTE_INCREASE = 0.05, 0.01

_Step = tuple[Fit, HeldoutError]


@dataclass(frozen=True)
class StageReport:
    """The stages, their models, and the states that the last stage predicts worse in some run than the first."""

    stages: list[DiagnosisStage]
    models: list[PhysicsModel]
    worse: tuple[WorsenedState, ...]


def stages_of(search: SearchState, shown: Heldout) -> StageReport:
    """Returns the stages: the given model refitted, then one per accepted effect, all fitted on the same windows.

    The search's own horizon determines the order; the errors are those of ``shown``. Effects are
    listed in the order in which they were accepted. If an effect helps only together with a later one, the order is
    that in which the error falls fastest, and ``search.added`` is reordered too. An effect that helps no run by itself
    shares a stage with the next one.
    """
    first = (search.first.fit, error_with(search.first.fit, search.shooting, search.heldout))
    steps = [first, *(_refitted_step(search, search.added[: count + 1]) for count in range(len(search.added)))]
    # Refitting other orders is only worth it if an addition raised the error. Of two effects, one that does not help
    # alone shares its stage with the other anyway.
    if any(later[1].value > earlier[1].value for earlier, later in pairwise(steps)) and len(search.added) > 2:
        search.added, steps = _greedy_order(search, first)
    names = search.heldout.windows.system.state_names
    errors = [
        error if shown is search.heldout else error_with(fitted, search.shooting, shown) for fitted, error in steps
    ]
    shown_stages = _helpful_stages(errors)
    found = []
    for number, before in zip(shown_stages, [None, *shown_stages], strict=False):
        error = errors[number]
        per_state = {name: float(value) for name, value in zip(names, error.per_state, strict=True)}
        gain = "" if before is None else error.improved_runs(errors[before])
        found.append(DiagnosisStage(tuple(search.added[:number]), error.value, per_state, gain))
    models = [steps[number][0].model for number in shown_stages]
    return StageReport(found, models, _worsened_states([errors[number] for number in shown_stages], shown))


def _helpful_stages(errors: Sequence[HeldoutError]) -> list[int]:
    """Returns the indices of the first and the last stage and of all that predict some run better than the one before.

    An effect that helps only together with a later one shares its stage.
    """
    retained = [0]
    for number in range(1, len(errors)):
        helps = (errors[number].by_run < errors[retained[-1]].by_run).any()
        if helps or number == len(errors) - 1:
            retained.append(number)
    return retained


def _worsened_states(errors: Sequence[HeldoutError], shown: Heldout) -> tuple[WorsenedState, ...]:
    """Returns the states of single runs that became worse, which the mean over states and runs hides."""
    if len(errors) < 2:
        return ()
    before, after = errors[0].by_run_and_state, errors[-1].by_run_and_state
    with np.errstate(invalid="ignore"):
        rows, states = np.nonzero((after > (1.0 + _RELATIVE_INCREASE) * before) & (after > before + _ABSOLUTE_INCREASE))
    names, runs = shown.windows.system.state_names, shown.windows.names
    found = [
        WorsenedState(len(errors) - 1, runs[row], names[state], float(before[row, state]), float(after[row, state]))
        for row, state in zip(rows.tolist(), states.tolist(), strict=True)
    ]
    return tuple(sorted(found, key=lambda item: item.before - item.after))


def _greedy_order(search: SearchState, first: _Step) -> tuple[list[str], list[_Step]]:
    """Returns the accepted effects in greedy order: at each step the one that gives the lowest error."""
    order: list[str] = []
    steps = [first]
    while len(order) < len(search.added):
        remaining = [name for name in search.added if name not in order]
        tried = {name: _refitted_step(search, [*order, name]) for name in remaining}
        best = min(remaining, key=lambda name: tried[name][1].value)
        order.append(best)
        # Greedy: trying all orders would need a factorial number of fits.
        steps.append(tried[best])
    return order, steps


def _refitted_step(search: SearchState, names: Sequence[str]) -> _Step:
    """Refits the first model with some of the accepted effects, starting from the values of the last model."""
    if set(names) == set(search.added):
        return search.current.fit, error_with(search.current.fit, search.shooting, search.heldout)
    model, final = search.first.fit.model, search.current.fit.model
    for name in names:
        item = next(effect_paths for effect_paths in search.current.fit.model.effects if effect_paths.name == name)
        model = model.with_effect(item, {p.name: final.settings[f"{name}.{p.name}"] for p in item.parameters})
    effect_paths = [path for path in model.settings if path.split(".")[0] in names]
    # Refitted, because parameters of a partial model compensate for the missing effects.
    found = fit(model, [*search.first.fit.paths, *effect_paths], search.shooting, search.current.fit.scale)
    return found, error_with(found, search.shooting, search.heldout)
