"""Sentences of an undecided diagnosis, and tables of what the data would have shown, from report.json."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

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
    values = ", ".join(_number_text(path, value) for path, value in closest_item["parameters"].items())
    fall = closest_item.get("heldout_fall")
    reduction = "" if fall is None else f"; it would reduce the error by {100.0 * fall:.0f} %"
    others = [item["effect"] for item in closest[1:]]
    also = f" Next: {', '.join(others)}." if others else ""
    return f"Undecided: {why}. Closest, likely but not proven: {closest_item['effect']} ({values}{reduction}).{also}"


def unsure_sentence(document: Mapping[str, Any], lacking: str, first: float, last: float) -> str:
    """Returns which effects help in the recorded driving although the data do not determine their sizes."""
    unsure = [item for item in document.get("closest") or () if item["effect"] in document["added"]]
    values = "; ".join(
        f"{item['effect']} ({', '.join(_number_text(path, value) for path, value in item['parameters'].items())})"
        for item in unsure
    )
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
    sizes = "; ".join(f"{item['effect']} {_size_text(item)}" for item in order[:_EXAMPLES])
    never = list(dict.fromkeys(item["effect"] for item in every if not _shown(item)))
    hidden = f" A typical size of {', '.join(never)} would not have been found." if never else ""
    return f"Of {len(every)} parameters of effects, {len(shown)} would have been found, from {sizes} on.{hidden}"


def closest_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str, str]]:
    """Returns (effect, parameters, reduction of the error, what to drive) of effects that may be missing."""
    rows = []
    for item in document.get("closest") or ():
        values = ", ".join(_number_text(path, value) for path, value in item["parameters"].items())
        fall = item.get("heldout_fall")
        rows.append((item["effect"], values, "" if fall is None else f"{100.0 * fall:.0f} %", item["drive"]))
    return rows


def detectable_rows(document: Mapping[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Returns (effect, parameter, smallest size, typical size, note) of everything that may be missing."""
    rows = []
    for item in document.get("detectable") or ():
        unit = "" if item["unit"] == "1" else f" {item['unit']}"
        smallest = "not detectable" if item.get("smallest") is None else f"{item['smallest']:.2g}{unit}"
        alongside = f"only as a sum with {', '.join(item['only_with'])}" if item["only_with"] else ""
        drive = f"drive: {item['drive']}" if item["drive"] else ""
        note = "; ".join(part for part in (alongside, drive) if part)
        rows.append((item["effect"], item["parameter"], smallest, f"{item['ordinary']:.2g}{unit}", note))
    return rows


def _shown(item: Mapping[str, Any]) -> bool:
    return item.get("smallest") is not None and item["smallest"] <= item["ordinary"]


def _size_text(item: Mapping[str, Any]) -> str:
    unit = "" if item["unit"] == "1" else f" {item['unit']}"
    return f"{item['parameter']} {item['smallest']:.2g}{unit}"


def _number_text(path: str, value: Mapping[str, Any]) -> str:
    spread = "" if value.get("std") is None else f" +- {value['std']:.2g}"
    unit = "" if value["unit"] == "1" else f" {value['unit']}"
    number = math.nan if value["value"] is None else float(value["value"])
    return f"{path.rsplit('.', maxsplit=1)[-1]} {number:.3g}{spread}{unit}"
