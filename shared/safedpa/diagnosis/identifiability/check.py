"""Identifiability check: which effects recordings could show, computed in seconds from the model's sensitivities."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from safedpa.diagnosis import diagnose as diagnosing
from safedpa.diagnosis.detectable import detectable_sizes, with_manoeuvres
from safedpa.diagnosis.fit.data_checks import check_data_sufficiency, data_at_horizon, prepare_runs
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.initial_model import base_bound_message, base_error_message, initial_search
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

__all__ = ["IdentifiabilityCheck", "as_document", "check_identifiability", "check_lines"]


@dataclass(frozen=True)
class IdentifiabilityCheck:
    """Which effects that the model lacks these recordings could show."""

    robot: str
    seconds: float
    """Horizon [s] on which a diagnosis would decide."""
    windows: int
    error: float
    """Held-out error of the given model, its free parameters refitted, over that horizon."""
    why_not: str
    """Why no effect can be identified at all; empty if some can."""
    sizes: tuple[Detectable, ...]
    data_quality: tuple[dict[str, Any], ...]
    poor_base: str = ""
    """Why the refitted base hides effects: parameters at bounds, or too large an error; empty if it does not."""

    def identifiable(self) -> list[Detectable]:
        """Parameters whose typical size would be found and that no other effect imitates."""
        return [item for item in self.sizes if item.shown and not item.only_with]

    def only_as_sums(self) -> list[Detectable]:
        """Parameters that would be found, but cannot be distinguished from another effect."""
        return [item for item in self.sizes if item.shown and item.only_with]

    def undetectable(self) -> list[Detectable]:
        """Parameters whose typical size would not be found."""
        return [item for item in self.sizes if not item.shown]


def check_identifiability(model: PhysicsModel, runs: Sequence[Run]) -> IdentifiabilityCheck:
    """Computes which effects the runs could show.

    Raises InputError for a model of another robot, RunError for unusable runs.
    """
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    sufficiency = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    # The free parameters are refitted first: what they can absorb is not identifiable as an effect.
    search = initial_search(model, evidence.shooting, evidence.heldout)
    sizes: Sequence[Detectable] = ()
    if sufficiency.enough:
        library = diagnosing.library_for(model)
        found = detectable_sizes(search.current, library, search.shooting, search.error)
        sizes = with_manoeuvres(found, search.current, library)
    return IdentifiabilityCheck(
        model.system.name,
        usable.seconds,
        len(evidence.shooting.windows),
        search.error.value,
        sufficiency.why_not,
        tuple(sizes),
        tuple(usable.quality),
        "; ".join(filter(None, (base_error_message(search), base_bound_message(search)))),
    )


def as_document(check: IdentifiabilityCheck) -> dict[str, Any]:
    """Returns the document that ``diagnose --check --json`` prints."""
    return {"format": 1, **asdict(check)}


def check_lines(check: IdentifiabilityCheck) -> list[str]:
    """Returns the check as lines of text."""
    lines = [
        f"Horizon {check.seconds:g} s, {check.windows} independent windows; the given model's error over it is "
        f"{check.error:.3g}."
    ]
    if check.poor_base:
        # Effects are judged by what they change next to this base, so its errors come before the lists.
        lines += [
            f"The first finding is the base itself: {check.poor_base}. What it gets wrong hides effects, so the sizes "
            "below hold next to this base only. Correct it, or run diagnose, which fits base and effects together."
        ]
    if check.why_not:
        # The reason comes before the lists, which are empty in that case.
        lines += [f"No effect can be identified: {check.why_not}."]
    lines += _part("Would be found, from this size on:", check.identifiable())
    lines += _part("Would be found, but only as a sum with another effect:", check.only_as_sums())
    hidden = "Would not be found at a typical size" + (", or the base hides them:" if check.poor_base else ":")
    lines += _part(hidden, check.undetectable())
    # Several runs often have the same finding; it is printed once.
    messages = list(dict.fromkeys(str(item["message"]) for item in check.data_quality))
    return [*lines, *(f"data: {message}" for message in messages)]


def _part(title: str, sizes: Sequence[Detectable]) -> list[str]:
    return [title, *(f"  {_line(item)}" for item in sizes)] if sizes else []


def _line(item: Detectable) -> str:
    unit = "" if item.unit == "1" else f" {item.unit}"
    size = "not detectable" if item.smallest is None else f"{item.smallest:.2g}{unit}"
    text = f"{item.effect} {item.parameter}: {size} (typical: {item.ordinary:.2g}{unit})"
    text += f"; together with {', '.join(item.only_with)}" if item.only_with else ""
    return text + (f"; drive: {item.drive}" if item.drive else "")
