"""Summary sentences of a fleet's diagnosis, from the contents of fleet.json."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_KINDS = {
    "nothing": "nothing is missing",
    "no_verdict": "no verdict",
    "unreadable": "unreadable",
    "failed": "the diagnosis failed",
}


def group_title(group: Mapping[str, Any]) -> str:
    """Returns what a group lacks, without values: ``rolling_resistance (or towed_load) and steering_offset``."""
    if group["effects"]:
        return " and ".join([_effect_title(item) for item in group["effects"]])
    if group["kind"] == "unexplained":
        return f"something that no effect describes: {group['reason']}"
    return _KINDS[str(group["kind"])]


def _effect_title(item: Mapping[str, Any]) -> str:
    others = item["indistinguishable_from"]
    return str(item["effect"]) + (f" (or {', '.join(others)})" if others else "")


def range_text(number: Mapping[str, Any]) -> str:
    """Returns a range such as ``0.41 to 0.48 m/s2``, or one value if the robots agree."""
    unit = "" if number["unit"] == "1" else f" {number['unit']}"
    low, high = f"{number['low']:.3g}", f"{number['high']:.3g}"
    return f"{low}{unit}" if low == high else f"{low} to {high}{unit}"


def numbers_text(group: Mapping[str, Any]) -> str:
    """Returns the parameters of a group with their ranges over the robots."""
    parts = []
    for item in group["effects"]:
        own = ", ".join(f"{name} {range_text(number)}" for name, number in item["parameters"].items())
        parts.append(own if len(group["effects"]) == 1 else f"{item['effect']}: {own}")
    return "; ".join(parts)


def headline(document: Mapping[str, Any]) -> str:
    """Returns one sentence on the fleet: ``60 robots: 3 lack rolling_resistance (...); in 55 nothing is missing.``"""
    parts = [_reported(group) for group in document["groups"]]
    total = len(document["robots"])
    return f"{total} robot{'' if total == 1 else 's'}: {'; '.join(parts)}."


def _reported(group: Mapping[str, Any]) -> str:
    count, title = len(group["robots"]), group_title(group)
    one = count == 1
    if group["kind"] == "missing":
        return f"{count} lack{'s' if one else ''} {title} ({numbers_text(group)})"
    if group["kind"] == "unexplained":
        return f"{count} lack{'s' if one else ''} {title}"
    if group["kind"] == "suspected":
        return f"in {count} {title} is suspected only"
    if group["kind"] == "unreadable":
        return f"{count} {'is' if one else 'are'} unreadable"
    if group["kind"] == "no_verdict":
        return f"{count} allow{'s' if one else ''} no verdict"
    return f"{'in' if group['kind'] == 'nothing' else 'for'} {count} {title}"


def common_sentence(document: Mapping[str, Any]) -> str:
    """Describes effects common to all robots; empty without any."""
    common = document["common"]
    if common is None:
        return ""
    reported = " ".join(f"{_common_part(item)} {_tried_text(item)}" for item in common["effects"])
    text = f"The fleet has in common: {reported}"
    return f"{text} Correct the model file: {common['model']} holds it." if common["model"] else text


def _common_part(item: Mapping[str, Any]) -> str:
    numbers = ", ".join(f"{name} {_mean_text(number)}" for name, number in item["parameters"].items())
    if item["together"] is not None:
        where = f"found in {item['found_in']} of {item['of']} robots by themselves, but in all together"
        where += f" {item['together']:.1f} standard errors"
        where += f"; better on the robots than {', '.join(item['instead_of'])}" if item["instead_of"] else ""
    else:
        where = f"found in {item['found_in']} of {item['of']} robots"
    kind = "; it differs from robot to robot, so it stands free in the model" if item["differs"] else ""
    return f"{_effect_title(item)}, {numbers} ({where}{kind})."


def _tried_text(item: Mapping[str, Any]) -> str:
    tried = item["confirmed"]
    if not tried["robots"]:
        return "It could not be tried on the robots."
    share = f"{tried['better']} of {tried['robots']} robots are predicted better with the others' numbers"
    errors = f"the median error goes from {tried['before']:.3g} to {tried['after']:.3g}"
    return f"{share}; {errors}." if tried["holds"] else f"It does not belong to the model: only {share}; {errors}."


def _mean_text(number: Mapping[str, Any]) -> str:
    unit = "" if number["unit"] == "1" else f" {number['unit']}"
    return f"{number['mean']:.4g} ± {number['std']:.2g}{unit}"


def discovery_sentence(document: Mapping[str, Any]) -> str:
    """Describes the false discovery rate of the groups."""
    found = document["false_discovery"]
    if not found["found"]:
        return ""
    demoted = found["found"] - found["believed"]
    text = (
        f"Something is missing in {found['found']} of {found['judged']} robots that were judged; {found['believed']} "
        f"of these findings stand up to a fleet of this size (at most {100 * found['share']:.0f} % of them are "
        "expected to be false, Benjamini and Hochberg)"
    )
    return f"{text}, {demoted} {'is' if demoted == 1 else 'are'} suspected only." if demoted else f"{text}."


def listed(names: Sequence[str], most: int = 6) -> str:
    """Returns the names, abbreviated if there are many."""
    if len(names) <= most:
        return ", ".join(names)
    return f"{', '.join(names[: most - 1])} and {len(names) - most + 1} more"
