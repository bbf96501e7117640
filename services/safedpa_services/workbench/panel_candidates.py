"""The third column: what may be missing, what speaks for it and against, and the engineer's decision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from safedpa_services.workbench.elements import action, escaped, panel, text
from safedpa_services.workbench.evidence import CandidateCard
from safedpa_services.workbench.session import Session

__all__ = ["CandidatesPanel"]

_BADGES = {"accepted": "best", "suspected": "possible", "rejected": "unlikely"}

_NOT_CONFIRMED = "None of these is confirmed by unseen data. You may add one all the same."
_SEARCHING = (
    "Each effect of the library is fitted to the recordings and judged on stretches that its fit did not see. "
    "The rest of the page works meanwhile."
)

Decide = Callable[[str], Any]


class CandidatesPanel:
    """One card a candidate; one of them is open."""

    def __init__(
        self,
        on_add: Decide,
        on_reject: Decide,
        on_cancel: Callable[[], None],
        phrase: tuple[str, str] = ("Add", "Reject"),
    ) -> None:
        self._on_add, self._on_reject, self._text = on_add, on_reject, phrase
        self._cards: list[CandidateCard] = []
        self.open = 0
        self._foreseen: dict[str, str] = {}
        self._consequence: ui.html | None = None
        with panel(3, "What is missing"):
            with ui.element("div").classes("row tight") as self._busy:
                ui.spinner(size="18px")
                self._progress = text("", "quiet grow").props("role=status aria-live=polite")
                action("Cancel", on_cancel, hint="end the search")
            self._note = text("", "note", "div")
            self._head = text("→ held-out error with it", "quiet right")
            self._list = ui.element("div").classes("cards").props('role=list aria-label="candidates"')
            self._next = text("", "note", "div")

    def busy(self, sentence: str) -> None:
        """Shows what is computed; empty: nothing is."""
        self._busy.set_visibility(bool(sentence))
        self._progress.set_content(escaped(sentence))

    def show(self, session: Session | None) -> None:
        """Draws the candidates of the present version."""
        proposed = None if session is None else session.proposed
        cards = [] if session is None else session.cards()
        experiment = None if proposed is None else proposed.next_experiment
        notice = ""
        if experiment is not None:
            separates = ", ".join(experiment.separates).replace("_", " ")
            notice = f"Next experiment: {experiment.manoeuvre}. It separates {separates}: {experiment.why}."
        nothing = proposed is not None and proposed.choice is None and bool(cards)
        self.show_cards(cards, notice, _NOT_CONFIRMED if nothing else (_SEARCHING if proposed is None else ""))

    def show_cards(self, cards: list[CandidateCard], experiment: str, note: str) -> None:
        """Draws cards, the first one open, with a note above and the proposed experiment below."""
        self._cards, self.open = cards, 0
        self._next.set_visibility(bool(experiment))
        self._next.set_content(escaped(experiment))
        self._note.set_visibility(bool(note))
        self._note.set_content(escaped(note))
        self._head.set_visibility(bool(cards))
        self._draw()

    def foretell(self, foreseen: dict[str, str]) -> None:
        """What each effect would do if it were added, by effect; stands above the buttons of the open card."""
        self._foreseen = foreseen
        if self._consequence is not None:
            self._consequence.set_content(escaped(self._foreseen.get(self.effect, "")))
            self._consequence.set_visibility(self.effect in self._foreseen)

    def move(self, by: int) -> None:
        """Opens the next or the previous card."""
        if self._cards:
            self.open = max(0, min(len(self._cards) - 1, self.open + by))
            self._draw()
            ui.run_javascript("document.querySelector('.candidate.open > button')?.focus()")

    @property
    def effect(self) -> str:
        """The candidate that is open; empty where there is none."""
        return self._cards[self.open].effect if self._cards else ""

    def _toggle(self, index: int) -> None:
        self.open = index
        self._draw()

    def _draw(self) -> None:
        self._consequence = None
        self._list.clear()
        with self._list:
            for index, card in enumerate(self._cards):
                self._card(index, card)

    def _card(self, index: int, card: CandidateCard) -> None:
        opened = index == self.open
        item = ui.element("div").classes("candidate" + (" open" if opened else "")).props("role=listitem")
        with item:
            head = ui.element("button").props(f"aria-expanded={'true' if opened else 'false'} type=button")
            head.on("click", lambda _event, at=index: self._toggle(at))
            with head:
                text(card.effect.replace("_", " "), "name")
                if card.error is not None:
                    text(f"→ {card.error:.3g}", "after")
                text(_BADGES[card.decision], f"badge {card.decision}")
            if opened:
                with ui.element("div").classes("body"):
                    self._body(card)

    def _body(self, card: CandidateCard) -> None:
        for equation in card.equations:
            text(equation, "equation", "div")
        for number in card.numbers:
            text(number, "number", "div")
        with ui.element("ul").props('aria-label="evidence"'):
            for line in card.speaks_for:
                text(line, "for", "li").props('aria-label="' + escaped(f"for: {line}") + '"')
            for line in card.speaks_against:
                text(line, "against", "li").props('aria-label="' + escaped(f"against: {line}") + '"')
        if card.equals:
            text(f"These data cannot tell it from {', '.join(card.equals).replace('_', ' ')}.", "problem", "div")
        if card.signature:
            text(f"Without it: {card.signature}.", "quiet", "div")
        self._consequence = text(self._foreseen.get(card.effect, ""), "consequence", "div")
        self._consequence.set_visibility(card.effect in self._foreseen)
        with ui.element("div").classes("row"):
            yes, no = self._text
            action(yes, lambda: self._on_add(card.effect), "a", hint=f"{yes.lower()} {card.effect}", main=True)
            action(no, lambda: self._on_reject(card.effect), "x", hint=f"{no.lower()} {card.effect}")
