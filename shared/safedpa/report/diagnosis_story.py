"""Sentences and tables of a diagnosis page, from the document of report.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any


@dataclass(frozen=True)
class AcceptedEffect:
    """One accepted effect: its parameters as text, and the effects that it cannot be distinguished from."""

    effect: str
    parameters: list[tuple[str, str, str, str]]
    """(name, value, standard deviation, unit)"""
    equals: list[str]


@dataclass(frozen=True)
class StageTable:
    """The candidates of one stage, best first, and the error before the stage."""

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
    """(effect, effects that the data cannot distinguish from it, decision)"""
    stages: list[StageTable]
    improved: list[tuple[str, str]]
    """(what a stage changed, in how many runs the error fell)"""
    formula_title: str
    formula_note: str
    formula_rows: list[tuple[str, str, str, str, str]]
    """(state, term, coefficient, standard deviation, unit)"""
    dependence: list[dict[str, Any]]
    """How much of the residual each variable explains, without negligible ones."""


def number(value: float | None) -> float:
    """Returns a number of the document; null is NaN."""
    return math.nan if value is None else float(value)


def step_text(before: Mapping[str, Any] | None, stage: Mapping[str, Any]) -> str:
    """Returns what one stage changed, such as ``+ quadratic_drag``, or "given model" for the first."""
    if before is None:
        return "given model"
    old, new = before["effects"], stage["effects"]
    parts = [f"+ {name}" for name in new if name not in old] + [f"− {name}" for name in old if name not in new]
    return " ".join(parts) or "refitted"


# Share of the residual that a variable has to explain for a row in the table.
_MIN_SHARE = 0.02
# Gaps that a sentence lists, the widest first.
_MAX_GAPS = 3

_FORMULA = {
    "place": (
        "A region where the floor is different",
        "Fitted like an effect, but valid in one room only. If all recordings were made there, inspect the floor in "
        "that region; if not, diagnose the recordings of one room at a time.",
    ),
    "formula": (
        "Best short formula for the missing rate",
        "Found by sparse regression. It is a formula that fits, not a physical effect; do not trust it outside the "
        "range of the data.",
    ),
    "dependence": (
        "The missing rate depends on this variable, but no short formula describes how",
        "The profile below shows the dependence; it is not a physical effect.",
    ),
}
"""Title and note by ``kind`` of the unexplained structure."""


def _formula_rows(unexplained: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    return [
        (
            item["state"],
            item["term"],
            f"{number(item['coefficient']):.4g}",
            "" if item["std"] is None else f"{item['std']:.2g}",
            "" if item["unit"] == "1" else item["unit"],
        )
        for item in unexplained.get("terms", ())
    ]


def report_text(document: Mapping[str, Any]) -> ReportText:
    """Returns all sentences and tables of a page."""
    found = [_found(document, stage, name) for stage, name in enumerate(document["added"])]
    groups = [
        (item["effect"], list(item["indistinguishable_from"]), item["decision"])
        for item in document["candidates"]
        if item["indistinguishable_from"] and item["decision"] != "rejected"
    ]
    stages = document["stages"]
    improved = [(step_text(before, stage), str(stage["runs_improved"])) for before, stage in pairwise(stages)]
    tables = _stages(document)
    unexplained = document["unexplained"] or {}
    title, note = _FORMULA.get(unexplained.get("kind", "formula"), _FORMULA["formula"])
    if unexplained.get("alternatives"):
        note += f" As good as its first term on unseen data: {', '.join(unexplained['alternatives'])}."
    dependence = [item for item in unexplained.get("dependence", ()) if number(item["share"]) > _MIN_SHARE]
    return ReportText(
        _lead(document),
        _residual_sentence(document),
        found,
        groups,
        tables,
        improved,
        title,
        note,
        _formula_rows(unexplained),
        dependence,
    )


def _lead(document: Mapping[str, Any]) -> str:
    warning = naive_sentence(document)
    return f"{warning} {_verdict(document)}" if warning else _verdict(document)


def _verdict(document: Mapping[str, Any]) -> str:
    stages, added = document["stages"], document["added"]
    first, last = number(stages[0]["heldout_error"]), number(stages[-1]["heldout_error"])
    if added:
        return _added_sentence(document, first, last)
    if document["verdict"] == "undecided":
        return undecided_sentence(document)
    if document["verdict"] == "nothing_missing":
        sizes = nothing_sentence(document)
        return (
            f"Nothing is missing{gaps_clause(document)}, as far as was tried: {none_of(document)} predicts unseen data "
            f"better than chance{_noise_clause(document)}. The error is {first:.3g}.{' ' if sizes else ''}{sizes}"
        )
    unexplained = document["unexplained"]
    if unexplained is not None and not unexplained["depends_on"]:
        return f"No verdict: {unexplained['expression']}."
    return f"Something is missing: {none_of(document)} explains it. The error is {first:.3g}.{_remains(document)}"


def _added_sentence(document: Mapping[str, Any], first: float, last: float) -> str:
    """Returns the verdict if effects were added; ``first`` and ``last`` are the errors without and with them."""
    added = document["added"]
    fall = 100.0 * (1.0 - last / first) if first > 0 else 0.0
    verb = "falls" if fall > 0 else "changes"
    lacking, them = [_described(document, name) for name in added], "it" if len(added) == 1 else "them"
    if document["verdict"] == "undecided":
        return unsure_sentence(document, _joined(lacking), first, last)
    if document["verdict"] == "unexplained" and (document.get("remainder") or {}).get("sentence"):
        return (
            f"Something is missing that no set of the effects tried explains. {_joined(lacking)} would reduce the "
            f"error on data that was not used for fitting from {first:.3g} to {last:.3g}, but that is not all: "
            f"{document['remainder']['sentence']}. Do not rely on the model in other driving."
        )
    return (
        f"The model lacks {_joined(lacking)}{gaps_clause(document)}. With {them} the error on data that was "
        f"not used for fitting {verb} from {first:.3g} to {last:.3g}, by {abs(fall):.0f} %."
    )


def none_of(document: Mapping[str, Any]) -> str:
    """Returns what was tried, as "none of the 34 effects and 12 combinations tried"."""
    effects, combined = document.get("tried") or (0, 0)
    pairs = f" and {combined} combination{'s' if combined != 1 else ''}" if combined else ""
    return f"none of the {effects} effect{'s' if effects != 1 else ''}{pairs} tried"


def _noise_clause(document: Mapping[str, Any]) -> str:
    if not document.get("remainder"):
        return ""
    return ", and what remains depends on no state, action, history or time that was measured"


def _remains(document: Mapping[str, Any]) -> str:
    """Returns a sentence with size and place of what is not explained; empty if nothing is known about it."""
    sentence = (document.get("remainder") or {}).get("sentence") or ""
    return f" {sentence[0].upper()}{sentence[1:]}." if sentence else ""


def gaps_clause(document: Mapping[str, Any]) -> str:
    """Returns a clause that names gaps in the coverage of the recordings; empty if there are none."""
    found = [(item, gap) for item in document.get("coverage") or () for gap in item["gaps"]]
    if not found:
        return ""
    names = _joined([_gap_text(item, gap) for item, gap in sorted(found, key=_by_width)[:_MAX_GAPS]])
    return f", judged without {names}, where these recordings contain little data and the model extrapolates"


def _by_width(found: tuple[Mapping[str, Any], Mapping[str, Any]]) -> float:
    """Returns the negative width of a gap relative to its range, as a sort key: the widest first."""
    item, gap = found
    return -float(gap["high"] - gap["low"]) / float(item["high"] - item["low"])


def _gap_text(item: Mapping[str, Any], gap: Mapping[str, Any]) -> str:
    seconds = f"{gap['seconds']:.0f} of {item['seconds']:.0f} s"
    return f"{item['variable']} {gap['low']:.2g} to {gap['high']:.2g}{_unit(item)} ({seconds})"


def _described(document: Mapping[str, Any], name: str) -> str:
    """Returns the name of an effect, or the sentence of its law if it has one."""
    sentences = [item["sentence"] for item in document.get("conditions") or () if item["effect"] == name]
    return sentences[0] if sentences else name


def _residual_sentence(document: Mapping[str, Any]) -> str:
    unexplained = document["unexplained"]
    if unexplained is None:
        return ""
    variables = _joined(unexplained["depends_on"]) or "no variable that was measured"
    share = unexplained.get("share")
    size = f"{100.0 * share:.0f} % of the residual" if isinstance(share, int | float) else "A part of the residual"
    if unexplained.get("kind") == "place":
        return (
            f"{size} lies in one region of the plane: if these recordings are of one room, the floor is different "
            f"there. {none_of(document).capitalize()} describes that."
        )
    return f"{size} depends on {variables} in a way that {none_of(document)} describes."


def _found(document: Mapping[str, Any], stage: int, name: str) -> AcceptedEffect:
    """Returns the accepted candidate of a stage; if several stages list the effect, the last one."""
    accepted = [item for item in document["candidates"] if item["effect"] == name and item["decision"] == "accepted"]
    accepted = [item for item in accepted if item["stage"] == stage] or accepted
    if not accepted:
        return AcceptedEffect(name, [], [])
    rows = [
        (key, rounded(number(entry["value"]), entry.get("std")), deviation_text(entry.get("std")), entry["unit"])
        for key, entry in _parameters(document, name, accepted[-1]["parameters"]).items()
    ]
    return AcceptedEffect(name, rows, list(accepted[-1]["indistinguishable_from"]))


def _parameters(document: Mapping[str, Any], name: str, trial: Mapping[str, Any]) -> Mapping[str, Any]:
    """Returns the parameters of the last model by name, or those of the accepted trial if the model has none."""
    final = document.get("parameters") or {}
    return {path.split(".")[1]: entry for path, entry in final.items() if path.split(".")[0] == name} or trial


def _stages(document: Mapping[str, Any]) -> list[StageTable]:
    """Returns one table for each question: trials that follow one another without an addition share it."""
    found: dict[str, StageTable] = {}
    have: list[str] = []
    for index in sorted({int(item["stage"]) for item in document["candidates"]}):
        own = [item for item in document["candidates"] if item["stage"] == index]
        question = "What does the given model lack?" if not have else f"What is missing besides {_joined(have)}?"
        before = next(
            (stage for stage in document["stages"] if set(have) <= set(stage["effects"])), document["stages"][-1]
        )
        rows = [_candidate_row(item, before, document["added"]) for item in own]
        if question in found:
            known = {item["effect"] for item in found[question].candidates}
            found[question].candidates.extend(row for row in rows if row["effect"] not in known)
        else:
            found[question] = StageTable(index, question, number(before["heldout_error"]), rows)
        accepted = [name for item in own if item["decision"] == "accepted" for name in item["effect"].split(" + ")]
        have = [*have, *(name for name in dict.fromkeys(accepted) if name in document["added"] and name not in have)]
    return list(found.values())


def _candidate_row(item: Mapping[str, Any], stage: Mapping[str, Any], added: Sequence[str]) -> dict[str, Any]:
    """Returns a candidate with its texts; an effect that was found later is called accepted in every table."""
    later = item["decision"] != "accepted" and set(item["effect"].split(" + ")) <= set(added)
    return {
        **item,
        "decision": "accepted" if later else item["decision"],
        "reason": f"{item['reason']}; accepted at a later stage" if later else item["reason"],
        "text": parameters_text(item["parameters"]),
        "width": _width(item["heldout_error"], stage),
    }


def _width(error: float | None, stage: Mapping[str, Any]) -> float:
    """Returns the length of the bar in per cent: full at the error without the candidate."""
    if error is None or not number(stage["heldout_error"]) > 0:
        return 0.0
    return min(100.0, 100.0 * error / float(stage["heldout_error"]))


def parameters_text(parameters: Mapping[str, Any]) -> str:
    """Returns parameters as text, such as "coefficient 0.121 ± 0.003 1/m", separated by commas."""
    return ", ".join(_value_text(name, entry, "±") for name, entry in parameters.items())


def _short_values(parameters: Mapping[str, Any]) -> str:
    """Returns parameters by path as text without their effects, in ASCII for a terminal."""
    return ", ".join(_value_text(path.split(".")[-1], entry, "+-") for path, entry in parameters.items())


def _value_text(name: str, entry: Mapping[str, Any], sign: str) -> str:
    std = entry.get("std")
    spread = "" if std is None else f" {sign} {deviation_text(std)}"
    return f"{name} {rounded(number(entry['value']), std)}{spread}{_unit(entry)}"


def deviation_text(std: float | None) -> str:
    """Returns a standard deviation with two digits; empty if it is unknown."""
    return "" if std is None else f"{std:.2g}"


def rounded(value: float, std: float | None) -> str:
    """Returns a value with the digits that its deviation allows: as many decimals as the deviation is written with.

    Example:

        >>> rounded(0.0008754, 0.0018), rounded(18.7812, 8.2), rounded(-2.0, 0.01), rounded(0.7283, None)
        ('0.0009', '18.8', '-2.00', '0.7283')
    """
    if std is None or not (math.isfinite(std) and std > 0.0 and math.isfinite(value)):
        return f"{value:.4g}"
    written = deviation_text(std)
    if "e" in written:
        digits = math.floor(math.log10(abs(value))) - math.floor(math.log10(std)) + 2 if value else 1
        return f"{value:.{max(1, digits)}g}"
    return f"{value:.{len(written.partition('.')[2])}f}"


def _unit(entry: Mapping[str, Any]) -> str:
    return "" if entry["unit"] == "1" else f" {entry['unit']}"


def _joined(names: list[str]) -> str:
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else "".join(names)


_NAIVE = {"no_change": "predicting no change", "constant_velocity": "predicting constant velocity"}
# Sizes that a sentence quotes; the table lists all.
_EXAMPLES = 3


def undecided_sentence(document: Mapping[str, Any]) -> str:
    """Returns why nothing was decided, and the effect that comes closest."""
    unexplained, closest = document.get("unexplained"), document.get("closest") or []
    why = f"{unexplained['expression']}" if unexplained else _why(document, closest)
    if not closest:
        return f"Undecided: {why}."
    closest_item = closest[0]
    values = _short_values(closest_item["parameters"])
    fall = closest_item.get("heldout_fall")
    reduction = "" if fall is None else f"; it would reduce the error by {100.0 * fall:.0f} %"
    others = [item["effect"] for item in closest[1:]]
    also = f" Next: {', '.join(others)}." if others else ""
    return f"Undecided: {why}. Closest, likely but not proven: {closest_item['effect']} ({values}{reduction}).{also}"


def unsure_sentence(document: Mapping[str, Any], lacking: str, first: float, last: float) -> str:
    """Returns which effects help in the recorded driving although the data do not determine their sizes."""
    unsure = [item for item in document.get("closest") or () if item["effect"] in document["added"]]
    values = "; ".join(f"{item['effect']} ({_short_values(item['parameters'])})" for item in unsure)
    return (
        f"Undecided: with {lacking} the error on such driving falls from {first:.3g} to {last:.3g}, but these data do "
        f"not determine the size of {values}. Do not rely on the model in other driving."
    )


def _why(document: Mapping[str, Any], closest: Sequence[Mapping[str, Any]]) -> str:
    if closest:
        return "not enough data to decide whether an effect is missing"
    hidden = [item["effect"] for item in document.get("detectable") or () if not _shown(item)]
    names = ", ".join(dict.fromkeys(hidden))
    return f"the data are too uniform: a typical size of {names} would not have been found"


def naive_sentence(document: Mapping[str, Any]) -> str:
    """Returns a warning if the refitted given model is worse than a naive prediction; else an empty string."""
    naive = {name: value for name, value in (document.get("naive") or {}).items() if value is not None}
    if not naive or document["stages"][0]["heldout_error"] is None:
        return ""
    given = float(document["stages"][0]["heldout_error"])
    name = min(naive, key=lambda item: naive[item])
    if not given > naive[name] > 0:
        return ""
    return (
        f"The given model, its free parameters refitted, predicts worse than {_NAIVE.get(name, name)}: its error is "
        f"{given:.3g}, compared with {naive[name]:.3g}."
    )


def nothing_sentence(document: Mapping[str, Any]) -> str:
    """Returns from which size on effects would have been found."""
    every = document.get("detectable") or []
    shown = [item for item in every if item.get("smallest") is not None]
    if not shown:
        return ""
    order = sorted(shown, key=lambda item: item["smallest"] / item["ordinary"])
    examples = order[:_EXAMPLES]
    sizes = "; ".join(f"{item['effect']} {item['parameter']} {item['smallest']:.2g}{_unit(item)}" for item in examples)
    never = list(dict.fromkeys(item["effect"] for item in every if not _shown(item)))
    hidden = f" A typical size of {', '.join(never)} would not have been found." if never else ""
    return f"Of {len(every)} parameters of effects, {len(shown)} would have been found, from {sizes} on.{hidden}"


def closest_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Returns (effect, parameters, reduction of the error, what to drive) of effects that may be missing."""
    rows = []
    for item in document.get("closest") or ():
        values = _short_values(item["parameters"])
        fall = item.get("heldout_fall")
        rows.append((item["effect"], values, "" if fall is None else f"{100.0 * fall:.0f} %", item["drive"]))
    return rows


def detectable_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Returns (effect, parameter, smallest size, typical size, note) of everything that may be missing."""
    rows = []
    for item in document.get("detectable") or ():
        unit = _unit(item)
        smallest = "not detectable" if item.get("smallest") is None else f"{item['smallest']:.2g}{unit}"
        alongside = f"only as a sum with {', '.join(item['only_with'])}" if item["only_with"] else ""
        drive = f"drive: {item['drive']}" if item["drive"] else ""
        note = "; ".join(part for part in (alongside, drive) if part)
        rows.append((item["effect"], item["parameter"], smallest, f"{item['ordinary']:.2g}{unit}", note))
    return rows


def _shown(item: Mapping[str, Any]) -> bool:
    return item.get("smallest") is not None and item["smallest"] <= item["ordinary"]
