"""Effects with a law, in words: what acts where, and how a number varies."""

from __future__ import annotations

from collections.abc import Iterable

from safedpa.diagnosis.document import Condition
from safedpa.dynamics import PhysicsModel
from safedpa.effects import Conditioned, Varies, Where

__all__ = ["conditions_of"]


def conditions_of(model: PhysicsModel, names: Iterable[str]) -> tuple[Condition, ...]:
    """The laws of the named effects of a model, with a sentence each.

    ``rolling resistance 0.9 m/s2 beyond x = 1.00 m``; ``speed command gain 1.00 at time 0 s, falls by 0.4 % a second``.
    """
    wanted = list(names)
    found = []
    for item in model.effects:
        if item.name in wanted and isinstance(item, Conditioned):
            law = item.law
            assert isinstance(law, (Varies, Where))
            edge = law.edge if isinstance(law, Where) else None
            found.append(Condition(item.name, law.key, law.words, edge, _sentence(model, item)))
    return tuple(sorted(found, key=lambda one: wanted.index(one.effect)))


def _sentence(model: PhysicsModel, item: Conditioned) -> str:
    values = {p.name: model.settings[f"{item.name}.{p.name}"].value for p in item.parameters}
    told = item.law.sentence(values, item.inner, model.system)
    every = item.inner.parameters
    numbers = [_number(p.name if len(every) > 1 else "", values[p.name], p.unit) for p in every]
    name = item.name.replace("_", " ")
    if isinstance(item.law, Varies):
        return f"{name} {', '.join(numbers)} at {item.law.begin(model.system)}, {told}"
    return f"{name} {', '.join(numbers)} {told}"


def _number(name: str, value: float, unit: str) -> str:
    return " ".join(part for part in (name, f"{value:.3g}", "" if unit == "1" else unit) if part)
