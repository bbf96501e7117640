"""The live page: the robots on the bus, what their diagnosis finds, and a person's decisions about it."""

from __future__ import annotations

import asyncio
import getpass
import time
from collections.abc import Callable
from itertools import zip_longest
from typing import Any

from nicegui import events, ui

from safedpa.bus import Answer, Request
from safedpa.robot import DEFAULT_ROBOT
from safedpa_services.workbench.browser import answer_of, prefers_dark
from safedpa_services.workbench.elements import action, escaped, named, panel, text
from safedpa_services.workbench.help import show_keys
from safedpa_services.workbench.live_book import RobotHistory
from safedpa_services.workbench.live_link import LiveLink, QueryResult
from safedpa_services.workbench.live_panels import (
    change_lines,
    driven_lines,
    error_bars,
    error_figure,
    evidence_figure,
    field_figure,
    field_legend,
    live_cards,
)
from safedpa_services.workbench.look import DARK, LIGHT
from safedpa_services.workbench.panel_candidates import CandidatesPanel
from safedpa_services.workbench.replay_link import ReplayLink

__all__ = ["LivePage"]

_PICTURE_SECONDS = 0.4
_STATUS_SECONDS = 1.5
_END_SECONDS = 10.0
_GONE = """<script>
  const words = ['No connection to the live page.',
    'The drive has ended, or this machine is too busy; what is shown is the last of it.'];
  const name = () => document.querySelectorAll('#popup span').forEach((span, at) => {
    span.textContent = words[at] || '';
  });
  const say = () => {
    if (document.querySelector('main.bench') || document.getElementById('gone')) return;
    document.body.prepend(Object.assign(document.createElement('p'), {id: 'gone', textContent: words.join(' ')}));
  };
  addEventListener('load', name);
  addEventListener('error', (event) => { if (event.target.tagName) say(); }, true);
  setTimeout(say, 10000);
</script>"""
"""Whatever of the page reached the browser says so when the rest does not: the server goes with the drive, and may go
while its scripts are on their way. Else the words would be the framework's own, or none on a white page."""


class LivePage:
    """What one browser tab shows of the fleet."""

    def __init__(self, link: LiveLink | ReplayLink) -> None:
        self._link = link
        self._robot = ""
        self._look = LIGHT
        self._accepted: tuple[str, ...] = ()
        self._reported = ""
        self._pending = ""
        self._earlier = 0
        self._ended = False
        self._drawn: Any = None
        self._shown: Any = None
        self._asking = self._gone = False
        ui.add_head_html(_GONE)
        link.untold.add(self)  # from the first byte on: a drive may end while the page loads
        self._build()

    def _build(self) -> None:
        self._dark = ui.dark_mode(None)
        ui.keyboard(self._pressed, ignore=["input", "select", "textarea"])
        with ui.element("main").classes("bench"):
            ui.html('<a class="skip" href="#column-3">Skip to the candidates</a>', sanitize=False)
            with ui.element("header").classes("top"):
                text("safedpa workbench, live", tag="h1")
                self._what = text("", "what")
                text("robot", "quiet")
                self._choice = named(ui.select([], on_change=self._chosen), "robot")
                self._choice.props("dense outlined options-dense").classes("flat").style("width: 110px")
                text("you", "quiet")
                self._who = ui.input(value=_account()).props("dense outlined").classes("flat")
                named(self._who, "your name, for the recording").style("width: 110px")
                action("Recordings", lambda: ui.navigate.to("/"), "r", hint="work on recorded drives")
                action("Dark", self._toggle_dark, "d", hint="dark or light page")
                action("Keys", show_keys, "?", hint="list of keyboard shortcuts")
            self._verdict = text("", "verdict", "div").props('role=status aria-live=polite id="verdict"')
            self._problem = text("", "verdict problem", "div").props("role=alert")
            self._stationary = text("", "verdict problem", "div").props('role=status aria-live=polite id="stands"')
            with ui.element("div").classes("columns"):
                self._panels()
        self._problem.set_visibility(False)
        self._stationary.set_visibility(False)
        ui.timer(_PICTURE_SECONDS, self.show)
        ui.timer(_STATUS_SECONDS, self.ask_status)

    def _panels(self) -> None:
        with panel(1, "The robot and its prediction"):
            self._filter = text("", "quiet", "div")
            self._legend = ui.html(sanitize=False).classes("legend")
            self._field = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="robot in its field"')
            self._driven = ui.html(sanitize=False)
        with panel(2, "Where the model fails"):
            self._where = text("", "quiet", "div")
            self._error = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="error and its band"')
            self._evidence = ui.plotly({"data": []}).classes("still").style("height: 190px")
            self._evidence.props('role=img aria-label="evidence and its threshold"')
        self._candidates = CandidatesPanel(self._accept, self._reject, lambda: None, phrase=("Accept", "Reject"))
        self._candidates.busy("")
        with panel(4, "The error falls"):
            self._bars = ui.html(sanitize=False)
            text("changes of the model", "quiet")
            self._changes = ui.html(sanitize=False).classes("cards")
            with ui.element("div").classes("bottom"):
                self._message = text("", "note", "div").props("role=status aria-live=polite")
                with ui.element("div").classes("row"):
                    self._back = action(
                        "Roll back", self._roll_back, "u", hint="back to the model before the last change"
                    )
        self._back.set_visibility(False)

    def close(self) -> None:
        """The tab is gone."""
        self._gone = True
        self._link.untold.discard(self)

    async def begin(self) -> None:
        """Chooses dark or light as the browser prefers."""
        dark = await prefers_dark()
        if not self._gone:
            self._set_dark(dark)
            self.show()

    # showing

    @property
    def _book(self) -> RobotHistory | None:
        return self._link.book.robots.get(self._robot)

    def show(self) -> None:
        """Draws what is known now; once the drive has ended, that, and nothing any more."""
        if self._ended:
            return
        if self._link.ended:
            ui.timer(0.0, self._end, once=True)
            self._ended = True
            return
        robots = sorted(self._link.book.robots)
        if robots != self._choice.options:
            self._choice.set_options(robots, value=self._robot if self._robot in robots else next(iter(robots), None))
        book, link = self._book, self._link
        self._what.set_content(escaped(f"{link.title}, {len(robots)} robot{'s' * (len(robots) != 1)}"))
        if book is None:
            self._verdict.set_content(escaped(f"No robot is heard ({link.title}). Start one with: safedpa up"))
            self._trouble(link.book.last_refusal and f"Refused: {link.book.last_refusal}")
            return
        finding = book.finding
        self._verdict.set_content(escaped(_capital(finding.sentence) if finding else "No finding was heard yet."))
        self._trouble(book.silence(time.monotonic()) or book.mismatch() or (book.troubles[-1] if book.troubles else ""))
        stationary_for = book.stationary_reason()
        self._stationary.set_visibility(bool(stationary_for))
        self._stationary.set_content(escaped(stationary_for))
        self._filter.set_content(escaped(book.verdict.sentence if book.verdict else ""))
        self._where.set_content(escaped(_where(book)))
        self._legend.set_content(field_legend(self._look))
        self._driven.set_content(driven_lines(book))
        self._field.update_figure(field_figure(book, self._look))
        self._show_error(book)
        self._message.set_content(
            escaped(self._reported or "Accepted models are taken over by all services at one tick.")
        )
        self._show_candidates(book)

    def _show_error(self, book: RobotHistory) -> None:
        """Once a second, when there is a new error: drawing is the browser's most expensive work here."""
        state = (self._robot, book.epoch, book.errors[-1] if book.errors else None, len(book.marks), self._look)
        if state == self._shown:
            return
        self._shown = state
        self._error.update_figure(error_figure(book, self._look))
        self._evidence.update_figure(evidence_figure(book, self._look))
        self._bars.set_content(error_bars(book))
        self._changes.set_content(change_lines(book))

    async def _end(self) -> None:
        """The last word, which stays when the server is gone; the browser need not look for it."""
        book = self._book
        self._trouble("")
        self._stationary.set_visibility(False)
        account = "" if book is None else f" {book.account()}"
        self._verdict.set_content(escaped(f"The drive has ended.{account} What is shown here is the last of it."))
        self._candidates.show_cards([], "", "The drive has ended: nothing can be changed any more.")
        self._back.set_visibility(False)
        await answer_of("document.body.classList.add('ended'); return true", _END_SECONDS)
        self._link.untold.discard(self)

    def _trouble(self, sentence: str) -> None:
        self._problem.set_visibility(bool(sentence))
        self._problem.set_content(escaped(sentence))

    def _show_candidates(self, book: RobotHistory) -> None:
        state = (self._robot, self._accepted, book.report_of, book.report is None)
        if state == self._drawn:
            return
        self._drawn = state
        kind = str((book.report or {}).get("robot", DEFAULT_ROBOT))
        cards, experiment = live_cards(kind, book.report, self._accepted)
        note = "" if cards else "Nothing to decide: candidates stand here once a finding was searched."
        self._candidates.show_cards(cards, experiment, note)

    # asking

    async def ask_status(self) -> None:
        """Which effects can be accepted now, and what came of the last change."""
        robot, book = self._robot, self._book
        if book is None or self._asking or book.found is None:
            return
        self._asking = True
        try:
            reported = await self._link.ask(robot, Request(do="status"))
        finally:
            self._asking = False
        if robot != self._robot:
            return
        if reported.answer is None:
            self._accepted, self._reported, self._earlier = (), reported.sentence, 0
        else:
            if self._pending and not reported.answer.pending:
                ui.notify(_capital(reported.sentence), timeout=8000, multi_line=True)
            self._pending, self._earlier = reported.answer.pending, reported.answer.earlier
            self._accepted = reported.answer.candidates
            self._candidates.foretell(_consequences(reported.answer, book))
            pending = f" ({reported.answer.pending} …)" if reported.answer.pending else ""
            self._reported = reported.sentence + pending
        self._back.set_visibility(self._earlier > 0)

    async def _ask(self, do: str, effect: str = "") -> None:
        book = self._book
        if book is None:
            return
        seen = book.finding
        request = Request(
            do=do,
            effect=effect,
            model=seen.model if seen else "",
            finding=seen.number if seen else 0,
            who=str(self._who.value or "workbench"),
        )
        reported = await self._link.ask(self._robot, request)
        self._reported = _answered(do, reported)
        ui.notify(self._reported, type="positive" if reported.ok else "negative", timeout=6000, multi_line=True)
        await self.ask_status()

    async def _accept(self, effect: str = "") -> None:
        effect = effect or self._candidates.effect
        if effect:
            await self._ask("accept", effect)

    async def _reject(self, effect: str = "") -> None:
        effect = effect or self._candidates.effect
        if effect:
            await self._ask("reject", effect)

    async def _roll_back(self) -> None:
        if self._earlier:
            await self._ask("roll_back")
        else:
            ui.notify("There is no model to go back to: this is the one that the robot began with.")

    # the page itself

    def _chosen(self) -> None:
        if self._choice.value and self._choice.value != self._robot:
            self._robot, self._accepted, self._reported, self._drawn = str(self._choice.value), (), "", None

    def _toggle_dark(self) -> None:
        self._set_dark(self._look is LIGHT)

    def _set_dark(self, dark: bool) -> None:
        self._dark.set_value(dark)
        self._look = DARK if dark else LIGHT

    async def _pressed(self, event: events.KeyEventArguments) -> None:
        modifiers = event.modifiers
        if not event.action.keydown or event.action.repeat or modifiers.ctrl or modifiers.alt or modifiers.meta:
            return
        keys: dict[str, Callable[[], Any]] = {
            "a": self._accept,
            "x": self._reject,
            "u": self._roll_back,
            "j": lambda: self._candidates.move(1),
            "k": lambda: self._candidates.move(-1),
            "d": self._toggle_dark,
            "r": lambda: ui.navigate.to("/"),
            "?": show_keys,
        }
        if str(event.key) in keys:
            done = keys[str(event.key)]()
            if asyncio.iscoroutine(done):
                await done


_DONE = {"accept": "Accepted", "reject": "Rejected", "roll_back": "Rolled back"}


def _answered(do: str, reported: QueryResult) -> str:
    """The answer to a click, which begins with what became of it."""
    if reported.answer is None:
        return reported.sentence
    if reported.ok:
        return f"{_DONE[do]}: {reported.sentence}."
    return f"Refused because {reported.sentence.removeprefix('refused: ').rstrip('.')}."


def _consequences(answer: Answer, book: RobotHistory) -> dict[str, str]:
    """What accepting each effect would do, with h and margin of now."""
    verdict = book.verdict
    now = "" if verdict is None else f" Now h is {verdict.h_now:.2f}, the margin {verdict.margin:.3f}."
    waits = "what it does to the margin is being computed; the filter tells it in any case before it is used"
    after = "All services take it over at one tick; the robot drives on meanwhile."
    foreseen = zip_longest(answer.candidates, answer.foreseen[: len(answer.candidates)], fillvalue="")
    return {effect: f"If you accept: {reported or waits}.{now} {after}" for effect, reported in foreseen}


def _where(book: RobotHistory) -> str:
    finding = book.finding
    if finding is None:
        return ""
    where = f"{finding.where}; " if finding.where else ""
    return f"{where}{100 * finding.coverage:.1f} % of the steps stayed within the margin"


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _account() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "workbench"
