"""The third column: candidate effects with the evidence for and against each, and the user's decision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from safedpa_services.workbench.panels.elements import button, escaped, panel, text, with_table
from safedpa_services.workbench.session.candidate_cards import CandidateCard
from safedpa_services.workbench.session.session import Session

_BADGES = {"accepted": "best", "suspected": "possible", "rejected": "unlikely"}

_NOT_CONFIRMED = "Unseen data confirm none of these. You may add one all the same."
_SEARCHING = (
    "Each effect of the library is fitted to the recordings and evaluated on stretches that the fit did not see. "
    "You can use the rest of the page meanwhile."
)

Decide = Callable[[str], Any]


class CandidatesPanel:
    """Shows a card for each candidate; one card is open."""

    def __init__(
        self,
        on_add: Decide,
        on_reject: Decide,
        on_cancel: Callable[[], None],
        button_labels: tuple[str, str] = ("Add", "Reject"),
    ) -> None:
        self._on_add, self._on_reject, self._labels = on_add, on_reject, button_labels
        self._cards: list[CandidateCard] = []
        self.open = 0
        self._consequences: dict[str, str] = {}
        self._consequence: ui.html | None = None
        with panel(3, "What is missing"):
            with ui.element("div").classes("row tight") as self._busy:
                ui.spinner(size="18px")
                self._progress = text("", "quiet grow").props("role=status aria-live=polite")
                button("Cancel", on_cancel, hint="cancel the search")
            self._note = text("", "note", "div")
            self._head = text("→ held-out error with it", "quiet right")
            self._list = ui.element("div").classes("cards").props('role=list aria-label="candidates"')
            self._next = text("", "note", "div")

    def show_progress(self, sentence: str) -> None:
        """Shows the progress of a job; an empty text hides it."""
        self._busy.set_visibility(bool(sentence))
        self._progress.set_content(escaped(sentence))

    def show(self, session: Session | None) -> None:
        """Shows the candidates of the present version."""
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
        """Shows cards, the first one open, with a note above and the proposed experiment below."""
        self._cards, self.open = cards, 0
        self._next.set_visibility(bool(experiment))
        self._next.set_content(escaped(experiment))
        self._note.set_visibility(bool(note))
        self._note.set_content(escaped(note))
        self._head.set_visibility(bool(cards))
        self._draw()

    def show_consequences(self, consequences: dict[str, str]) -> None:
        """Sets the consequence of adding each effect; the open card shows it above its buttons."""
        self._consequences = consequences
        if self._consequence is not None:
            self._consequence.set_content(with_table(self._consequences.get(self.effect, "")))
            self._consequence.set_visibility(self.effect in self._consequences)

    def move(self, by: int) -> None:
        """Opens the card that is ``by`` places further down."""
        if self._cards:
            self.open = max(0, min(len(self._cards) - 1, self.open + by))
            self._draw()
            ui.run_javascript("document.querySelector('.candidate.open > button')?.focus()")

    @property
    def effect(self) -> str:
        """Effect of the open card; empty if there is none."""
        return self._cards[self.open].effect if self._cards else ""

    def _open_card(self, index: int) -> None:
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
            head.on("click", lambda _event, at=index: self._open_card(at))
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
        for parameter in card.parameters:
            text(parameter, "number", "div")
        with ui.element("ul").props('aria-label="evidence"'):
            for line in card.speaks_for:
                text(line, "for", "li").props('aria-label="' + escaped(f"for: {line}") + '"')
            for line in card.speaks_against:
                text(line, "against", "li").props('aria-label="' + escaped(f"against: {line}") + '"')
        if card.indistinguishable_from:
            text(
                f"These data cannot distinguish it from {', '.join(card.indistinguishable_from).replace('_', ' ')}.",
                "problem",
                "div",
            )
        if card.signature:
            text(f"Without it: {card.signature}.", "quiet", "div")
        consequence = with_table(self._consequences.get(card.effect, ""))
        self._consequence = ui.html(consequence, sanitize=False, tag="div").classes("consequence")
        self._consequence.set_visibility(card.effect in self._consequences)
        with ui.element("div").classes("row"):
            add, reject = self._labels
            button(add, lambda: self._on_add(card.effect), "a", hint=f"{add.lower()} {card.effect}", main=True)
            button(reject, lambda: self._on_reject(card.effect), "x", hint=f"{reject.lower()} {card.effect}")
