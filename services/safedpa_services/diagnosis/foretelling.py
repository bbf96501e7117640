"""What another model's margin would do to a robot, in words, before anybody accepts it."""

from __future__ import annotations

from safedpa.bus import VerdictMessage
from safedpa.errors import InputError
from safedpa.live.foresight import Foretell
from safedpa.safety.margin_change import margin_change
from safedpa.safety.margin_text import margin_from_text
from safedpa.safety.settings import FilterSettings
from safedpa.safety.shipped import settings_named

__all__ = ["foretell_with"]

_WITHOUT_H = ("fallback", "disabled", "stopped")


def foretell_with(settings: str) -> Foretell:
    """For the filter's settings (a file or a name).

    Of h the verdict tells the least of all barriers alone; it stands for every kind, which is on the safe side. The
    filter tells of each kind by itself once the model is offered.
    """
    known = settings_named(settings)

    def foretell(present: str, other: str, verdict: VerdictMessage | None) -> str:
        if not other:
            return "no margin could be calibrated for it from this drive: the filter will use the shipped one, or none"
        try:
            old, new = _epsilon(present, known), _epsilon(other, known)
        except InputError as error:
            return f"its margin cannot be read: {error}"
        unknown = verdict is None or (verdict.status in _WITHOUT_H and verdict.h_now == verdict.h_next == 0.0)
        h = {} if verdict is None or unknown else dict.fromkeys(new, verdict.h_now)
        return margin_change(old, new, h, known.eta) or f"the margin stays as it is: {_listed(new)}"

    return foretell


def _epsilon(text: str, settings: FilterSettings) -> dict[str, float]:
    return dict(margin_from_text(text).epsilon if text else settings.epsilon)


def _listed(margins: dict[str, float]) -> str:
    return ", ".join(f"{kind} {value:.3g}" for kind, value in sorted(margins.items()))
