"""What a diagnosis got right, once the truth is opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf, isfinite
from typing import Any

Document = Mapping[str, Any]

_DELAY_FOR_LAG = {"steering_delay": "steering_lag", "drive_delay": "drive_lag"}
_BORDERS = ("_above", "_below", "at_x", "at_y", "radius")
_BORDER, _SHARE = 0.2, 0.2
"""How far a number of a law may be from the truth: borders in their unit, others as a share."""
_NEAR = 0.03
"""How far a number of what is present next to the hidden effects may be from what was measured, as a share."""


@dataclass(frozen=True)
class Found:
    """A fitted parameter next to the truth."""

    path: str
    value: float
    std: float
    """Stated."""
    truth: float

    @property
    def deviation(self) -> float:
        """(value - truth) / std"""
        return (self.value - self.truth) / self.std


@dataclass(frozen=True)
class Outcome:
    """One case: what was hidden and what was reported."""

    suite: str
    case: str
    hidden: tuple[str, ...]
    added: tuple[str, ...]
    verdict: str
    first_named: bool
    """What was added first is hidden."""
    all_named: bool
    """Every hidden effect was added."""
    all_in_group: bool
    """Every hidden effect was added, or is named as what the data cannot tell from something added, or is taken up
    whole by a free gain."""
    wrong: tuple[str, ...]
    """Added effects that are not hidden and stand for nothing that is."""
    parameters: tuple[Found, ...]
    """Every parameter of every hidden effect that was added."""
    error: float
    """Held-out error of the last stage."""
    error_ratio: float
    """That over the error of the same fit with the true effects, or of the true robot where no library has them; NaN
    where there is none to compare with."""
    seconds: float
    """By the clock."""
    processor_seconds: float = float("nan")
    """Of one core: what the clock would say on a machine that does nothing else."""
    reported: tuple[str, ...] = ()
    """What was reported about where, when or how numbers vary: ``rolling_resistance where x above``."""
    laws_reported: bool = True
    """Every hidden law was reported, of its effect, in its words, with its numbers near the truth."""
    false_laws: tuple[str, ...] = ()
    """Laws that were reported of effects that have none."""

    @property
    def deviations(self) -> tuple[float, ...]:
        """(value - truth) / stated standard deviation of the parameters."""
        return tuple(item.deviation for item in self.parameters)

    @property
    def right(self) -> bool:
        """As the suite wants it: effects in their group, with their laws; nothing where nothing is.

        Of bad data anything may be said but an effect; what no library has is unexplained.
        """
        if self.suite == "bad":
            return not self.added
        if self.suite == "own_outside":
            return self.verdict == "unexplained"
        if not self.hidden:
            return self.verdict == "nothing_missing" and not self.added
        return self.all_in_group and self.laws_reported


def judged(
    case: str,
    document: Document,
    truth: Document,
    oracle: float | None,
    seconds: float,
    processor_seconds: float = float("nan"),
) -> Outcome:
    """Compares report.json with the sealed truth; ``oracle`` is the held-out error with the true effects fitted."""
    hidden, added = tuple(truth["effects"]), tuple(document["added"])
    groups = {name: _group(document, name) for name in added}
    # A group that names half of the library is no answer.
    most = truth.get("largest_group", inf)
    groups = {name: group if len(group) <= most else {name} for name, group in groups.items()}
    absorbed = set(truth["absorbed"])
    found = {name: _is_represented(name, groups, truth) or name in absorbed for name in hidden}
    laws = truth.get("laws", {})
    reported = [(item["effect"], f"{item['kind']} {item['phrase']}") for item in document.get("conditions", ())]
    error = float(document["stages"][-1]["heldout_error"])
    return Outcome(
        suite=truth["suite"],
        case=case,
        hidden=hidden,
        added=added,
        verdict=document["verdict"],
        first_named=bool(added) and added[0] in hidden,
        all_named=set(hidden) <= set(added),
        all_in_group=all(found.values()),
        wrong=tuple(
            name for name in added if not _justified(name, groups, truth) and not _present(document, truth, name)
        ),
        reported=tuple(f"{name} {phrase}" for name, phrase in reported),
        laws_reported=all((name, phrase) in reported and _near(document, truth, name) for name, phrase in laws.items()),
        false_laws=tuple(f"{name} {phrase}" for name, phrase in reported if name not in laws),
        parameters=tuple(_found(document, truth)),
        error=error,
        error_ratio=error / oracle if oracle else float("nan"),
        seconds=seconds,
        processor_seconds=processor_seconds,
    )


def _group(document: Document, name: str) -> set[str]:
    """An added effect and all that its candidates are reported to be indistinguishable from."""
    own = [item for item in document["candidates"] if item["effect"] == name and item["decision"] == "accepted"]
    return {name}.union(
        *({part.strip() for part in other.split("+")} for item in own for other in item["indistinguishable_from"])
    )


def _is_represented(name: str, groups: Mapping[str, set[str]], truth: Document) -> bool:
    """Added itself; or something added is reported to be indistinguishable from it, or from nothing but its equals."""
    if any(name in group for group in groups.values()):
        return True
    return any(len(group) > 1 and set(truth["equals"][name]) & group for group in groups.values())


def _justified(name: str, groups: Mapping[str, set[str]], truth: Document) -> bool:
    hidden = set(truth["effects"])
    equals = {other for name_hidden in hidden for other in truth["equals"][name_hidden]}
    # an actuator that is neither a pure lag nor a pure delay may be called either, not both
    late = {other for other, lag in _DELAY_FOR_LAG.items() if lag in truth["present"] and lag not in groups}
    return name in hidden | equals | set(truth["present"]) | late or bool(groups[name] & hidden)


def _present(document: Document, truth: Document, name: str) -> bool:
    """Whether an effect is known to be there as well, and each of its numbers near what it is known to be."""
    near = {path: value for path, value in truth["present_near"].items() if path.split(".")[0] == name}
    own = _last_parameters(document, name)
    if not near or any(entry not in near for entry in (f"{name}.{key}" for key in own)):
        return False
    return all(abs(float(own[path.split(".")[1]]["value"]) - value) <= _NEAR * value for path, value in near.items())


def _near(document: Document, truth: Document, name: str) -> bool:
    """Whether every number of an effect with a law is near the truth: by a fifth, borders by 0.2 of their unit."""
    own = _last_parameters(document, name)
    for key, value in truth["effects"][name].items():
        entry = own.get(key)
        border = key.endswith(_BORDERS)
        if entry is None or abs(float(entry["value"]) - value) > (_BORDER if border else _SHARE * abs(value)):
            return False
    return True


def _found(document: Document, truth: Document) -> list[Found]:
    """From the last stage that reports the effect."""
    found = []
    for name, parameters in truth["effects"].items():
        own = _last_parameters(document, name)
        for key, value in parameters.items():
            entry = own.get(key)
            if entry is not None and entry.get("std"):
                item = Found(f"{name}.{key}", float(entry["value"]), float(entry["std"]), float(value))
                found += [item] if isfinite(item.deviation) else []
    return found


def _last_parameters(document: Document, name: str) -> Mapping[str, Any]:
    if name not in document["added"]:
        return {}
    final: Mapping[str, Any] = document.get("parameters") or {}
    own = {path.split(".")[1]: entry for path, entry in final.items() if path.split(".")[0] == name}
    if own and all(isinstance(entry, Mapping) for entry in own.values()):
        return own
    accepted = [item for item in document["candidates"] if item["effect"] == name and item["decision"] == "accepted"]
    parameters: Mapping[str, Any] = accepted[-1]["parameters"] if accepted else {}
    return parameters
