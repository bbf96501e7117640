"""What recordings could show, before anything is searched: in seconds, from the sensitivities of the model on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from safedpa.diagnosis.detectable import detectable_sizes, with_manoeuvres
from safedpa.diagnosis.diagnose import library_for
from safedpa.diagnosis.fit.data_checks import check_data_sufficiency, prepare_runs
from safedpa.diagnosis.fit.horizon import data_at_horizon
from safedpa.diagnosis.report_schema import Detectable
from safedpa.diagnosis.search.initial_model import initial_search
from safedpa.dynamics import PhysicsModel
from safedpa.records.run import Run

__all__ = ["IdentifiabilityCheck", "as_document", "check_identifiability", "check_lines"]


@dataclass(frozen=True)
class IdentifiabilityCheck:
    """What these recordings can tell of each effect that the model lacks."""

    robot: str
    seconds: float
    """Horizon [s] at which would be decided."""
    windows: int
    error: float
    """Held-out error of the given model, its free numbers refitted, over that horizon."""
    why_not: str
    """Why no effect can be told at all; empty where some can."""
    sizes: tuple[Detectable, ...]
    data_quality: tuple[dict[str, Any], ...]

    def reported(self) -> list[Detectable]:
        """Numbers of which an ordinary size would be found, and of which nothing else does the same."""
        return [item for item in self.sizes if item.shown and not item.only_with]

    def as_sums(self) -> list[Detectable]:
        """Numbers that would be found, but cannot be told from something else."""
        return [item for item in self.sizes if item.shown and item.only_with]

    def hidden(self) -> list[Detectable]:
        """Numbers of which an ordinary size would not be found."""
        return [item for item in self.sizes if not item.shown]


def check_identifiability(model: PhysicsModel, runs: Sequence[Run]) -> IdentifiabilityCheck:
    """Raises InputError for a model of another robot, RunError for unusable runs."""
    usable = prepare_runs(model, runs)
    evidence = data_at_horizon(usable.runs, usable.seconds)
    judge = check_data_sufficiency(evidence.shooting, usable.runs, runs)
    search = initial_search(model, evidence.shooting, evidence.heldout)
    sizes: Sequence[Detectable] = ()
    if judge.enough:
        library = library_for(model)
        found = detectable_sizes(search.current, library, search.shooting, search.error)
        sizes = with_manoeuvres(found, search.current, library)
    return IdentifiabilityCheck(
        model.system.name,
        usable.seconds,
        len(evidence.shooting.windows),
        search.error.value,
        judge.why_not,
        tuple(sizes),
        tuple(usable.quality),
    )


def as_document(check: IdentifiabilityCheck) -> dict[str, Any]:
    """The document that ``diagnose --check --json`` prints."""
    return {"format": 1, **asdict(check)}


def check_lines(check: IdentifiabilityCheck) -> list[str]:
    """The check as lines of text."""
    lines = [
        f"Decided over {check.seconds:g} s in {check.windows} independent windows; the given model's error there is "
        f"{check.error:.3g}."
    ]
    if check.why_not:
        lines += [f"Nothing can be told: {check.why_not}."]
    lines += _part("Would be found, from this size on:", check.reported())
    lines += _part("Would be found, but only as a sum with something else:", check.as_sums())
    lines += _part("Would not be found at an ordinary size:", check.hidden())
    messages = list(dict.fromkeys(str(item["message"]) for item in check.data_quality))
    return [*lines, *(f"data: {message}" for message in messages)]


def _part(title: str, sizes: Sequence[Detectable]) -> list[str]:
    return [title, *(f"  {_line(item)}" for item in sizes)] if sizes else []


def _line(item: Detectable) -> str:
    unit = "" if item.unit == "1" else f" {item.unit}"
    size = "not at all" if item.smallest is None else f"{item.smallest:.2g}{unit}"
    text = f"{item.effect} {item.parameter}: {size} (ordinary: {item.ordinary:.2g}{unit})"
    text += f"; together with {', '.join(item.only_with)}" if item.only_with else ""
    return text + (f"; drive: {item.drive}" if item.drive else "")
