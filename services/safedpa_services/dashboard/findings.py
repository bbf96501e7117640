"""What the diagnosis says, over time: error and band, stage, model in force, and marks where these change."""

from __future__ import annotations

import math
from typing import Final

from safedpa.bus import FindingMessage, ModelMessage
from safedpa_services.dashboard.palette import GREEN, GREY, ORANGE, PURPLE, SKY, VERMILLION, YELLOW
from safedpa_services.dashboard.shapes import Curves, Entry, Note, States, StateSet

__all__ = ["STAGE_COLOURS", "FindingBook"]

STAGE_COLOURS: Final = {
    "learning": GREY,
    "watching": GREEN,
    "raised": VERMILLION,
    "searching": ORANGE,
    "candidates": YELLOW,
    "nothing": PURPLE,
}
_ERROR: Final = Curves((), ("error over 1 s", "end of its band"), (SKY, ORANGE), (2.5, 1.5))
_LARGEST = 1e6
_MOST_MODELS = 16
"""Colours of the model lane; further models share one."""
_LONGEST = 400
"""Characters of a line in the log."""


class FindingBook:
    """Entries of one robot's findings and changes of the model."""

    def __init__(self) -> None:
        self._stage = ""
        self._number = 0
        self._models: list[str] = []
        self._model = ""
        self._lane = ""

    def lanes(self) -> list[Entry]:
        """The lanes of the diagnosis and the model as they are now."""
        lanes = (("diagnosis", self._stage), ("model", self._lane))
        return [Entry(("verdict", name), States(state)) for name, state in lanes if state]

    @staticmethod
    def start() -> list[Entry]:
        """Static entries: names and colours."""
        models = {f"model {number + 1}": (SKY if number % 2 == 0 else YELLOW) for number in range(_MOST_MODELS)}
        return [
            Entry(("diagnosis", "error"), _ERROR, static=True),
            Entry(("verdict", "diagnosis"), StateSet(STAGE_COLOURS), static=True),
            Entry(("verdict", "model"), StateSet(models), static=True),
        ]

    def add(self, message: FindingMessage | ModelMessage) -> list[Entry]:
        """Error and band always; a mark and a line of the log where the stage or the model changes."""
        return self._finding(message) if isinstance(message, FindingMessage) else self._change(message)

    def _finding(self, message: FindingMessage) -> list[Entry]:
        band = message.band if message.band > 0.0 else math.nan
        entries = [Entry(("diagnosis", "error"), Curves((_gap(message.error), _gap(band))))]
        entries += self._in_force(message.model)
        if (message.stage, message.number) == (self._stage, self._number):
            return entries
        self._stage, self._number = message.stage, message.number
        colour = STAGE_COLOURS.get(message.stage, GREY)
        where = f" ({message.where})" if message.where else ""
        level = "WARN" if message.stage in ("raised", "candidates", "nothing") else "INFO"
        note = Note(f"diagnosis: {message.sentence}{where}"[:_LONGEST], colour, level)
        return [*entries, Entry(("verdict", "diagnosis"), States(message.stage)), Entry(("log",), note)]

    def _change(self, message: ModelMessage) -> list[Entry]:
        words = {"offer": "is offered", "take": f"is used from tick {message.from_tick} on", "drop": "is dropped"}
        told = words.get(message.step, message.step)
        who = f", by {message.who}" if message.who else ""
        text = f"model {message.fingerprint or message.replaces} {told}: {message.why}{who}"
        return [Entry(("log",), Note(text[:_LONGEST], PURPLE, "WARN" if message.step == "drop" else "INFO"))]

    def _in_force(self, fingerprint: str) -> list[Entry]:
        if fingerprint == self._model:
            return []
        self._model = fingerprint
        if fingerprint not in self._models and len(self._models) < _MOST_MODELS:
            self._models.append(fingerprint)
        number = self._models.index(fingerprint) + 1 if fingerprint in self._models else _MOST_MODELS
        self._lane = f"model {number}"
        return [Entry(("verdict", "model"), States(self._lane))]


def _gap(value: float) -> float:
    return value if abs(value) < _LARGEST else math.nan
