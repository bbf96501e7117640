"""The live page: the robots on the bus, the findings of their diagnosis, and the user's decisions about them."""

from __future__ import annotations

import getpass
import time
from collections.abc import Callable, Mapping
from itertools import zip_longest
from typing import Any

from nicegui import background_tasks, ui

from safedpa.bus import Answer, Request
from safedpa.bus.monitor import is_stale
from safedpa.systems.robots import DEFAULT_ROBOT
from safedpa_services.workbench.live.links import AbstractLink, QueryResult
from safedpa_services.workbench.live.panels import (
    change_lines,
    drive_table,
    error_bars,
    error_figure,
    evidence_figure,
    field_figure,
    field_legend,
    filter_sentence,
    finding_sentence,
    live_cards,
    where_text,
)
from safedpa_services.workbench.live.store import RobotHistory
from safedpa_services.workbench.panels.candidates import CandidatesPanel
from safedpa_services.workbench.panels.elements import button, escaped, panel, set_accessible_name, text
from safedpa_services.workbench.tab import AbstractTab, run_script

_REDRAW_SECONDS = 0.4
_STATUS_SECONDS = 1.5
_DRAWN_SECONDS = 10.0
"""Longest time to wait until the browser has taken a picture before it gets the next one."""
_END_TIMEOUT = 10.0
_CONNECTION_LOST_SCRIPT = """<script>
  const lines = ['No connection to the live page.',
    'The drive has ended, or this machine is too busy. The page shows the last state received.'];
  const name = () => document.querySelectorAll('#popup span').forEach((span, at) => {
    span.textContent = lines[at] || '';
  });
  const show = () => {
    if (document.querySelector('main.workbench') || document.getElementById('gone')) return;
    document.body.prepend(Object.assign(document.createElement('p'), {id: 'gone', textContent: lines.join(' ')}));
  };
  addEventListener('load', name);
  addEventListener('error', (event) => { if (event.target.tagName) show(); }, true);
  setTimeout(show, 10000);
</script>"""
"""Reports a lost connection, also while the page is still loading: the server ends with the drive, possibly before the
browser has all scripts. Otherwise the user would see NiceGUI's own message or a blank page."""


class LivePage(AbstractTab):
    """One browser tab of the live page; it shows one robot at a time."""

    title = "safedpa workbench, live"

    def __init__(self, link: AbstractLink) -> None:
        self._link = link
        self._robot = ""
        self._accepted: tuple[str, ...] = ()
        self._status_message = ""
        self._pending = ""
        self._earlier_models = 0
        self._drawn_candidates: Any = None
        self._drawn_errors: Any = None
        self._ended = self._request_pending = self._is_drawing = False
        self._client = ui.context.client
        ui.add_head_html(_CONNECTION_LOST_SCRIPT)
        link.pages_to_notify.add(self)  # before the page is built: the drive may end while it loads
        super().__init__()
        ui.timer(_REDRAW_SECONDS, self._redraw)
        ui.timer(_STATUS_SECONDS, self.ask_status)

    def build_header(self) -> None:
        """Builds the choice of the robot and the name of the user."""
        text("robot", "quiet")
        self._robot_select = set_accessible_name(ui.select([], on_change=self._on_robot_chosen), "robot")
        self._robot_select.props("dense outlined options-dense").classes("flat").style("width: 110px")
        text("you", "quiet")
        self._user_name = ui.input(value=_login_name()).props("dense outlined").classes("flat")
        set_accessible_name(self._user_name, "your name, for the recording").style("width: 110px")
        button("Recordings", lambda: ui.navigate.to("/"), "r", hint="page for recorded drives")

    def build(self) -> None:
        """Builds messages and columns."""
        self._problem = text("", "verdict problem", "div").props("role=alert")
        self._deadlock = text("", "verdict problem", "div").props('role=status aria-live=polite id="stands"')
        with ui.element("div").classes("columns"):
            self._panels()
        self._problem.set_visibility(False)
        self._deadlock.set_visibility(False)

    def _panels(self) -> None:
        with panel(1, "The robot and its prediction"):
            self._filter = text("", "quiet", "div")
            self._legend = ui.html(sanitize=False).classes("legend")
            self._field = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="robot in its field"')
            self._drive = ui.html(sanitize=False)
        with panel(2, "Where the model fails"):
            self._where_text = text("", "quiet", "div")
            self._error = ui.plotly({"data": []}).classes("grow").props('role=img aria-label="error and its band"')
            self._evidence = ui.plotly({"data": []}).classes("still").style("height: 190px")
            self._evidence.props('role=img aria-label="evidence and its threshold"')
        self._candidates = CandidatesPanel(self._accept, self._reject, lambda: None, button_labels=("Accept", "Reject"))
        self._candidates.show_progress("")
        with panel(4, "The error falls"):
            self._bars = ui.html(sanitize=False)
            text("changes of the model", "quiet")
            self._changes = ui.html(sanitize=False).classes("cards")
            with ui.element("div").classes("bottom"):
                self._message = text("", "note", "div").props("role=status aria-live=polite")
                with ui.element("div").classes("row"):
                    hint = "back to the model before the last change"
                    self._back = button("Roll back", self._roll_back, "u", hint=hint)
        self._back.set_visibility(False)

    def close(self) -> None:
        """Called when the tab was closed."""
        super().close()
        self._link.pages_to_notify.discard(self)

    async def begin(self) -> None:
        """Draws the page in the theme that the browser prefers."""
        await super().begin()
        if not self._closed:
            self.show()

    # showing

    @property
    def _history(self) -> RobotHistory | None:
        return self._link.store.robots.get(self._robot)

    def show(self) -> None:
        """Redraws the page; after the drive has ended, draws the end once and nothing more."""
        if self._ended:
            return
        if self._link.ended:
            ui.timer(0.0, self._end, once=True)
            self._ended = True
            return
        robots = sorted(self._link.store.robots)
        if robots != self._robot_select.options:
            chosen = self._robot if self._robot in robots else next(iter(robots), None)
            self._robot_select.set_options(robots, value=chosen)
        history, link = self._history, self._link
        self._what.set_content(escaped(f"{link.title}, {len(robots)} robot{'s' * (len(robots) != 1)}"))
        if history is None:
            self._verdict.set_content(escaped(f"No message from any robot ({link.title}). Start one with: safedpa up"))
            self._show_problem(link.store.last_refusal and f"Refused: {link.store.last_refusal}")
            return
        now = time.monotonic()
        # Of a robot whose messages are old, the alert is the headline.
        self._verdict.set_content(escaped(finding_sentence(history, now)))
        latest = history.problems[-1] if history.problems else ""
        self._show_problem(history.silence_message(now) or history.mismatch() or latest)
        deadlock = history.deadlock_message(now)
        self._deadlock.set_visibility(bool(deadlock))
        self._deadlock.set_content(escaped(deadlock))
        self._filter.set_content(escaped(filter_sentence(history, now)))
        self._where_text.set_content(escaped(where_text(history, now)))
        self._legend.set_content(field_legend(self._theme))
        self._drive.set_content(drive_table(history, now))
        self._field.update_figure(field_figure(history, self._theme))
        self._bars.set_content(error_bars(history, now))
        self._show_error(history)
        usual = "All services switch to an accepted model at the same tick."
        self._message.set_content(escaped(self._status_message or usual))
        self._show_candidates(history)

    def _redraw(self) -> None:
        """Redraws unless the browser has not taken the last picture yet: it keeps in memory what it has not drawn."""
        if self._is_drawing and not self._link.ended:
            return
        self.show()
        if not self._is_drawing and not self._ended:
            self._is_drawing = True
            background_tasks.create(self._await_browser())

    async def _await_browser(self) -> None:
        """Waits until the browser answers, which it does after all that was sent to it before."""
        with self._client:
            await run_script("return true", _DRAWN_SECONDS)
        self._is_drawing = False

    def _show_error(self, history: RobotHistory) -> None:
        """Redraws the error only when it is new, once a second: these figures are the most expensive to draw."""
        newest = history.errors[-1] if history.errors else None
        state = (self._robot, history.epoch, newest, len(history.marks), self._theme)
        if state == self._drawn_errors:
            return
        self._drawn_errors = state
        self._error.update_figure(error_figure(history, self._theme))
        self._evidence.update_figure(evidence_figure(history, self._theme))
        self._changes.set_content(change_lines(history))

    async def _end(self) -> None:
        """Shows the end of the drive. It stays after the server has ended; the browser must not try to reconnect."""
        history = self._history
        self._show_problem("")
        self._deadlock.set_visibility(False)
        summary = "" if history is None else f" {history.summary()}"
        self._verdict.set_content(escaped(f"The drive has ended.{summary} The page shows its last state."))
        self._candidates.show_cards([], "", "The drive has ended: nothing can be changed.")
        self._back.set_visibility(False)
        await run_script("document.body.classList.add('ended'); return true", _END_TIMEOUT)
        self._link.pages_to_notify.discard(self)

    def _show_problem(self, sentence: str) -> None:
        self._problem.set_visibility(bool(sentence))
        self._problem.set_content(escaped(sentence))

    def _show_candidates(self, history: RobotHistory) -> None:
        state = (self._robot, self._accepted, history.report_number, history.report is None)
        if state == self._drawn_candidates:
            return
        self._drawn_candidates = state
        kind = str((history.report or {}).get("robot", DEFAULT_ROBOT))
        cards, experiment = live_cards(kind, history.report, self._accepted)
        note = "" if cards else "Nothing to decide: candidates appear here after the search that follows a finding."
        self._candidates.show_cards(cards, experiment, note)

    # asking

    async def ask_status(self) -> None:
        """Requests the effects that can be accepted now, and the result of the last change."""
        robot, history = self._robot, self._history
        if history is None or self._request_pending or history.diagnosis_heard_at is None:
            return
        self._request_pending = True
        try:
            result = await self._link.ask(robot, Request(do="status"))
        finally:
            self._request_pending = False
        if robot != self._robot:
            return
        if result.answer is None:
            self._accepted, self._status_message, self._earlier_models = (), result.sentence, 0
        else:
            if self._pending and not result.answer.pending:
                ui.notify(_capitalized(result.sentence), timeout=8000, multi_line=True)
            self._pending, self._earlier_models = result.answer.pending, result.answer.earlier
            self._accepted = result.answer.candidates
            self._candidates.show_consequences(_consequence_texts(result.answer, history))
            pending = f" ({result.answer.pending} …)" if result.answer.pending else ""
            self._status_message = result.sentence + pending
        self._back.set_visibility(self._earlier_models > 0)

    async def _ask(self, do: str, effect: str = "") -> None:
        history = self._history
        if history is None:
            return
        finding = history.finding
        model, number = (finding.model, finding.number) if finding else ("", 0)
        who = str(self._user_name.value or "workbench")
        request = Request(do=do, effect=effect, model=model, finding=number, who=who)
        result = await self._link.ask(self._robot, request)
        self._status_message = _result_message(do, result)
        ui.notify(self._status_message, type="positive" if result.ok else "negative", timeout=6000, multi_line=True)
        await self.ask_status()

    async def _decide(self, do: str, effect: str) -> None:
        """Requests a decision about an effect, by default that of the open card."""
        effect = effect or self._candidates.effect
        if effect:
            await self._ask(do, effect)

    async def _accept(self, effect: str = "") -> None:
        await self._decide("accept", effect)

    async def _reject(self, effect: str = "") -> None:
        await self._decide("reject", effect)

    async def _roll_back(self) -> None:
        if self._earlier_models:
            await self._ask("roll_back")
        else:
            ui.notify("There is no earlier model: the robot uses the one that it started with.")

    # the page itself

    def _on_robot_chosen(self) -> None:
        if self._robot_select.value and self._robot_select.value != self._robot:
            self._robot = str(self._robot_select.value)
            self._accepted, self._status_message, self._drawn_candidates = (), "", None

    def keys(self) -> Mapping[str, Callable[[], Any]]:
        """What each key does."""
        return {
            "a": self._accept,
            "x": self._reject,
            "u": self._roll_back,
            "j": lambda: self._candidates.move(1),
            "k": lambda: self._candidates.move(-1),
            "r": lambda: ui.navigate.to("/"),
        }


_DONE_TEXTS = {"accept": "Accepted", "reject": "Rejected", "roll_back": "Rolled back"}


def _result_message(do: str, result: QueryResult) -> str:
    """Message about a decision; it begins with its result."""
    if result.answer is None:
        return result.sentence
    if result.ok:
        return f"{_DONE_TEXTS[do]}: {result.sentence}."
    return f"Refused because {result.sentence.removeprefix('refused: ').rstrip('.')}."


def _consequence_texts(answer: Answer, history: RobotHistory) -> dict[str, str]:
    """For each candidate, what accepting it would do, with the present h and margin."""
    verdict = history.verdict
    age = history.ages(time.monotonic())[1]
    known = verdict is not None and age is not None and not is_stale(age)
    now = f" Now h is {verdict.h_now:.2f}, the margin {verdict.margin:.3f}." if known and verdict is not None else ""
    pending = "its effect on the margin is being computed; the filter reports it before the model is used"
    after = "all services switch to it at the same tick; the robot keeps driving."
    foreseen = zip_longest(answer.candidates, answer.foreseen[: len(answer.candidates)], fillvalue="")
    texts = {}
    for effect, reported in foreseen:
        is_table = "\n" in reported
        phrase = f"{after}{now}\n{reported}" if is_table else f"{reported or pending}.{now} {_capitalized(after)}"
        texts[effect] = f"If you accept: {phrase}"
    return texts


def _capitalized(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _login_name() -> str:
    try:
        return getpass.getuser()
    except (OSError, KeyError):
        return "workbench"
