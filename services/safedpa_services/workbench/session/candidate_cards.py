"""Texts about candidates: the evidence for and against each, and the sentence at the top of the page."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass

from safedpa.diagnosis.report_schema import Candidate, FittedValue, Unexplained
from safedpa.effects import effects_of

_CHANCE_SIGMAS = 2.0
"""Gain in standard errors up to which it may be chance."""
_CLEAR_SIGMAS = 3.0
"""Gain in standard errors from which chance is practically excluded."""
_NEGLIGIBLE_CHANGE = 0.01
"""Relative change of the error that is too small to count."""
_WELL_KNOWN = 0.15
"""Relative standard deviation below which a parameter is well known."""
_POORLY_KNOWN = 0.3
"""Relative standard deviation from which a parameter is known only roughly."""


@dataclass(frozen=True)
class CandidateCard:
    """One candidate as the page shows it."""

    effect: str
    equations: tuple[str, ...]
    parameters: tuple[str, ...]
    """One line for each parameter, such as ``coefficient 0.30 ± 0.01 1/m``."""
    speaks_for: tuple[str, ...]
    speaks_against: tuple[str, ...]
    indistinguishable_from: tuple[str, ...]
    """Effects that these data cannot distinguish from it."""
    signature: str
    """How the predictions fail without it."""
    error: float | None
    """Held-out error with it; None if it was not evaluated over the horizon."""
    decision: str


def make_card(
    robot: str, item: Candidate, before: float, after: float | None, values: Mapping[str, FittedValue]
) -> CandidateCard:
    """Builds the card of a candidate.

    ``before`` and ``after`` are the held-out errors without and with it; ``values`` are its fully fitted parameters.
    """
    library = effects_of(robot)
    parts = [library[name] for name in item.effect.split(" + ") if name in library]
    numbers = values or item.parameters
    error = item.heldout_error if after is None else after
    return CandidateCard(
        item.effect,
        tuple(part.equation for part in parts),
        parameter_lines({path.split(".")[-1] if len(parts) == 1 else path: value for path, value in numbers.items()}),
        tuple(_speaks_for(item, before, error, numbers)),
        tuple(_speaks_against(item, before, error, numbers)),
        item.indistinguishable_from,
        "; ".join(part.signature for part in parts),
        error,
        item.decision,
    )


def parameter_lines(values: Mapping[str, FittedValue]) -> tuple[str, ...]:
    """Formats each parameter with one standard deviation and its unit."""
    found = []
    for path, item in values.items():
        owner, own = path.split(".") if "." in path else ("", path)
        alone = sum(key.startswith(f"{owner}.") for key in values) == 1
        name = own if owner in ("", "base") else (owner if alone else f"{owner} {own}")
        spread = "" if item.std is None else f" ± {item.std:.2g}"
        unit = "" if item.unit == "1" else f" {re.sub(r'(?<=[a-z])2', '²', item.unit)}"
        found.append(f"{name.replace('_', ' ')} {item.value:.3g}{spread}{unit}")
    return tuple(found)


def _speaks_for(item: Candidate, before: float, error: float | None, numbers: Mapping[str, FittedValue]) -> list[str]:
    found = []
    if error is not None and before > 0 and error < (1.0 - _NEGLIGIBLE_CHANGE) * before:
        found.append(f"error on data that the fit did not see {before:.3g} → {error:.3g} (−{_percent(before, error)})")
    if item.score is not None and item.score > _CHANCE_SIGMAS:
        clear = "clear of chance" if item.score > _CLEAR_SIGMAS else "hardly chance"
        found.append(f"predicts unseen stretches better by {item.score:.1f} standard errors: {clear}")
    spreads = [_relative(value) for value in numbers.values()]
    if spreads and max(spreads) < _WELL_KNOWN:
        found.append(
            f"its {'parameter is' if len(spreads) == 1 else 'parameters are'} known to {100 * max(spreads):.2g} %"
        )
    return found


def _speaks_against(
    item: Candidate, before: float, error: float | None, numbers: Mapping[str, FittedValue]
) -> list[str]:
    found = []
    if error is None:
        found.append("gains too little to be evaluated over the horizon")
    elif before > 0 and error > (1.0 + _NEGLIGIBLE_CHANGE) * before:
        found.append(f"the error on data that the fit did not see rises {before:.3g} → {error:.3g}")
    elif before > 0 and error > (1.0 - _NEGLIGIBLE_CHANGE) * before:
        found.append("the error on data that the fit did not see hardly changes")
    if item.score is None or item.score <= _CHANCE_SIGMAS:
        gain = "no gain" if item.score is None else f"a gain of {item.score:.1f} standard errors"
        found.append(f"{gain} on unseen stretches may be chance")
    found += [
        f"{path.split('.')[-1]} is known only to {min(100 * _relative(value), 999):.0f} %"
        for path, value in numbers.items()
        if _relative(value) >= _POORLY_KNOWN
    ]
    if "bound" in item.reason or "does the same" in item.reason or "place explains" in item.reason:
        found.append(item.reason.split("; ")[-1])
    return found


def verdict_sentence(choice: CandidateCard | None, before: float, why_not: str) -> str:
    """The result of a search in a sentence: an effect is missing, nothing is missing, or there is no verdict."""
    if why_not:
        return f"No verdict: {why_not}."
    if choice is None:
        return "Nothing more is missing: no effect of the library predicts unseen data better than chance."
    names = choice.effect.replace(" + ", " and ").replace("_", " ")
    verb = "are" if " + " in choice.effect else "is"
    if choice.error is None:
        return f"Probably missing: {names}."
    return (
        f"{names[0].upper()}{names[1:]} {verb} missing: with it the error on data that the fit did not see falls "
        f"from {before:.3g} to {choice.error:.3g}, by {_percent(before, choice.error)}."
    )


def unexplained_sentence(rest: Unexplained | None) -> str:
    """A sentence about the structure in the residuals that no effect explains; empty if there is none."""
    if rest is None or not rest.depends_on:
        return ""
    variables = " and ".join(rest.depends_on)
    return (
        f"{100 * rest.share:.0f} % of what remains depends on {variables} in a way that no effect of the library has: "
        f"{rest.expression} (an empirical formula, not an effect of the library)."
    )


def _relative(value: FittedValue) -> float:
    if value.std is None:
        return math.inf
    return abs(value.std / value.value) if value.value else math.inf


def _percent(before: float, after: float) -> str:
    return f"{100 * (1 - after / before):.0f} %" if before > 0 else "0 %"
