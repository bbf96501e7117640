"""What a diagnosis says in sentences, from the document that stands in report.json."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from safedpa.report.undecided_story import naive_sentence, nothing_sentence, undecided_sentence, unsure_sentence

__all__ = [
    "AcceptedEffect",
    "ReportText",
    "StageTable",
    "gaps_clause",
    "number",
    "parameters_text",
    "report_text",
    "step_text",
]


@dataclass(frozen=True)
class AcceptedEffect:
    """One accepted effect: its parameters as text, and what it cannot be told from."""

    effect: str
    parameters: list[tuple[str, str, str, str]]
    """(name, value, standard deviation, unit)"""
    equals: list[str]


@dataclass(frozen=True)
class StageTable:
    """The candidates of one stage, best first, next to the error that they were to lower."""

    number: int
    question: str
    error: float
    candidates: list[dict[str, Any]]


@dataclass(frozen=True)
class ReportText:
    """Sentences and tables of a page."""

    lead: str
    remains: str
    found: list[AcceptedEffect]
    groups: list[tuple[str, list[str], str]]
    """(effect, those that this data cannot tell from it, decision)"""
    stages: list[StageTable]
    improved: list[tuple[str, str]]
    """(what a stage changed, in how many runs the error fell)"""
    formula_title: str
    formula_note: str
    formula_rows: list[tuple[str, str, str, str, str]]
    """(state, term, coefficient, standard deviation, unit)"""
    dependence: list[dict[str, Any]]
    """How much of what remains each variable tells, those that tell anything."""


def number(value: float | None) -> float:
    """A number of the document, where null stands for what is not finite."""
    return math.nan if value is None else float(value)


def step_text(before: Mapping[str, Any] | None, stage: Mapping[str, Any]) -> str:
    """What one stage changed against the one before: ``+ quadratic_drag``, or the given model."""
    if before is None:
        return "given model"
    old, new = before["effects"], stage["effects"]
    parts = [f"+ {name}" for name in new if name not in old] + [f"− {name}" for name in old if name not in new]
    return " ".join(parts) or "refitted"


_REPORTS = 0.02
"""Share that is worth a line."""
_MOST_GAPS = 3
"""That are told in a sentence."""

_FORMULA = {
    "place": (
        "A place where the floor is different",
        "Fitted like an effect, but it is none: it holds in one room. If all recordings were made there, look at the "
        "floor in that place; if not, give those of one room at a time.",
    ),
    "formula": (
        "Best short formula for the remaining rate",
        "Found by sparse regression. It is a formula that fits, not a physical effect with a name; do not trust it "
        "outside the range of the data.",
    ),
    "dependence": (
        "The remaining rate depends on this, but no short formula describes how",
        "The profile below shows it; it is no physical effect with a name.",
    ),
}
"""Title and note, by kind of what is unexplained."""


def _formula_rows(rest: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    return [
        (
            item["state"],
            item["term"],
            f"{number(item['coefficient']):.4g}",
            "" if item["std"] is None else f"{item['std']:.2g}",
            "" if item["unit"] == "1" else item["unit"],
        )
        for item in rest.get("terms", ())
    ]


def report_text(document: Mapping[str, Any]) -> ReportText:
    """Everything that a page says in words."""
    found = [_found(document, stage, name) for stage, name in enumerate(document["added"])]
    groups = [
        (item["effect"], list(item["indistinguishable_from"]), item["decision"])
        for item in document["candidates"]
        if item["indistinguishable_from"] and item["decision"] != "rejected"
    ]
    order = sorted({int(item["stage"]) for item in document["candidates"]})
    stages = document["stages"]
    improved = [(step_text(before, stage), str(stage["runs_improved"])) for before, stage in pairwise(stages)]
    tables = [_stage(document, index) for index in order]
    rest = document["unexplained"] or {}
    title, note = _FORMULA.get(rest.get("kind", "formula"), _FORMULA["formula"])
    if rest.get("alternatives"):
        note += f" As good as its first term on unseen data: {', '.join(rest['alternatives'])}."
    dependence = [item for item in rest.get("dependence", ()) if number(item["share"]) > _REPORTS]
    return ReportText(
        _lead(document),
        _remains(document),
        found,
        groups,
        tables,
        improved,
        title,
        note,
        _formula_rows(rest),
        dependence,
    )


def _lead(document: Mapping[str, Any]) -> str:
    lost = naive_sentence(document)
    return f"{lost} {_verdict(document)}" if lost else _verdict(document)


def _verdict(document: Mapping[str, Any]) -> str:
    stages, added = document["stages"], document["added"]
    first, last = number(stages[0]["heldout_error"]), number(stages[-1]["heldout_error"])
    if added:
        fall = 100.0 * (1.0 - last / first) if first > 0 else 0.0
        verb = "falls" if fall > 0 else "changes"
        lacking, them = [_reported(document, name) for name in added], "it" if len(added) == 1 else "them"
        if document["verdict"] == "undecided":
            return unsure_sentence(document, _joined(lacking), first, last)
        return (
            f"The model lacks {_joined(lacking)}{gaps_clause(document)}. With {them} the error on data that was "
            f"not used for fitting {verb} from {first:.3g} to {last:.3g}, by {abs(fall):.0f} %."
        )
    if document["verdict"] == "undecided":
        return undecided_sentence(document)
    if document["verdict"] == "nothing_missing":
        reported = nothing_sentence(document)
        return (
            f"Nothing is missing{gaps_clause(document)}: no effect of the library predicts unseen data better than "
            f"chance would have it. The error is {first:.3g}.{' ' if reported else ''}{reported}"
        )
    if document["unexplained"] is not None and not document["unexplained"]["depends_on"]:
        return f"No verdict: {document['unexplained']['expression']}."
    return f"Something is missing that no effect of the library describes. The error is {first:.3g}."


def gaps_clause(document: Mapping[str, Any]) -> str:
    """Which parts of the driven ranges the recordings hardly hold, as an aside after what was found; empty for none."""
    found = [(item, gap) for item in document.get("coverage") or () for gap in item["gaps"]]
    if not found:
        return ""
    reported = [_gap_text(item, gap) for item, gap in sorted(found, key=_narrower)[:_MOST_GAPS]]
    names = " and ".join([", ".join(reported[:-1]), reported[-1]]) if len(reported) > 1 else reported[0]
    return f", judged without {names}, which these logs hardly hold (there the model is extrapolated)"


def _narrower(found: tuple[Mapping[str, Any], Mapping[str, Any]]) -> float:
    """Less the share of its range that a gap takes: the widest first."""
    item, gap = found
    return -float(gap["high"] - gap["low"]) / float(item["high"] - item["low"])


def _gap_text(item: Mapping[str, Any], gap: Mapping[str, Any]) -> str:
    unit = "" if item["unit"] == "1" else f" {item['unit']}"
    held = f"{gap['seconds']:.0f} of {item['seconds']:.0f} s"
    return f"{item['variable']} {gap['low']:.2g} to {gap['high']:.2g}{unit} ({held})"


def _reported(document: Mapping[str, Any], name: str) -> str:
    """An effect by its name; one that does not act everywhere and always alike with where, when and how much."""
    own = [item["sentence"] for item in document.get("conditions") or () if item["effect"] == name]
    return own[0] if own else name


def _remains(document: Mapping[str, Any]) -> str:
    unexplained = document["unexplained"]
    if unexplained is None:
        return ""
    variables = _joined(unexplained["depends_on"]) or "no variable that was measured"
    share = unexplained.get("share")
    size = f"{100.0 * share:.0f} % of what remains" if isinstance(share, int | float) else "A part of what remains"
    if unexplained.get("kind") == "place":
        return (
            f"{size} lies in one place of the plane: if these recordings are of one room, the floor is different "
            "there, which no effect of the library has."
        )
    return f"{size} depends on {variables} in a way that no effect of the library has."


def _found(document: Mapping[str, Any], stage: int, name: str) -> AcceptedEffect:
    """The accepted candidate of a stage; where several stages name it, the last one's numbers."""
    own = [item for item in document["candidates"] if item["effect"] == name and item["decision"] == "accepted"]
    own = [item for item in own if item["stage"] == stage] or own
    if not own:
        return AcceptedEffect(name, [], [])
    rows = [
        (key, f"{number(entry['value']):.4g}", "" if entry.get("std") is None else f"{entry['std']:.2g}", entry["unit"])
        for key, entry in _parameters(document, name, own[-1]["parameters"]).items()
    ]
    return AcceptedEffect(name, rows, list(own[-1]["indistinguishable_from"]))


def _parameters(document: Mapping[str, Any], name: str, trial: Mapping[str, Any]) -> Mapping[str, Any]:
    """The numbers of the last model, by name; those of the trial in which it was accepted where there are none."""
    final = document.get("parameters") or {}
    return {path.split(".")[1]: entry for path, entry in final.items() if path.split(".")[0] == name} or trial


def _stage(document: Mapping[str, Any], index: int) -> StageTable:
    stage = document["stages"][min(index, len(document["stages"]) - 1)]
    have = stage["effects"]
    question = "What does the given model lack?" if not have else f"What is missing next to {_joined(have)}?"
    candidates = [
        {**item, "text": parameters_text(item["parameters"]), "width": _width(item["heldout_error"], stage)}
        for item in document["candidates"]
        if item["stage"] == index
    ]
    return StageTable(index, question, number(stage["heldout_error"]), candidates)


def _width(error: float | None, stage: Mapping[str, Any]) -> float:
    """Length of the bar in per cent of the cell, full at the error without any candidate."""
    if error is None or not number(stage["heldout_error"]) > 0:
        return 0.0
    return min(100.0, 100.0 * error / float(stage["heldout_error"]))


def parameters_text(parameters: Mapping[str, Any]) -> str:
    """coefficient 0.121 ± 0.003 1/m, one after the other."""
    parts = []
    for name, entry in parameters.items():
        spread = "" if entry.get("std") is None else f" ± {entry['std']:.2g}"
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        parts.append(f"{name} {number(entry['value']):.3g}{spread}{unit}")
    return ", ".join(parts)


def _joined(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)
