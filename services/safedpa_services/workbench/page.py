"""The page: four columns over one session, and its keys."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from safedpa.errors import SafedpaError
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.bench import Bench, News
from safedpa_services.workbench.browser import answer_of, prefers_dark
from safedpa_services.workbench.brush import Brush
from safedpa_services.workbench.elements import action, escaped, text
from safedpa_services.workbench.help import show_keys
from safedpa_services.workbench.look import DARK, LIGHT
from safedpa_services.workbench.open_dialog import OpenDialog
from safedpa_services.workbench.panel_candidates import CandidatesPanel
from safedpa_services.workbench.panel_fall import ErrorReductionPanel
from safedpa_services.workbench.panel_path import PathPanel
from safedpa_services.workbench.panel_where import WherePanel, window_near
from safedpa_services.workbench.rerun_view import RerunViewerServer
from safedpa_services.workbench.session import Session
from safedpa_services.workbench.session_files import SESSION_FILE

__all__ = ["WorkbenchPage"]


class WorkbenchPage:
    """What one browser tab shows of the bench: its own eye on a session that all tabs share."""

    def __init__(self, bench: Bench, door: RerunViewerServer, upload_store: FileStore, *, live: bool = False) -> None:
        self._bench, self._door, self._live, self._upload_store = bench, door, live, upload_store
        self._session: Session | None = None
        """This tab's view."""
        self._gone = False
        self._look = LIGHT
        self._build()

    def _build(self) -> None:
        self._dark = ui.dark_mode(None)
        ui.keyboard(self._pressed, ignore=["input", "select", "textarea"], repeating=True)
        with ui.element("main").classes("bench"):
            ui.html('<a class="skip" href="#column-3">Skip to the candidates</a>', sanitize=False)
            with ui.element("header").classes("top"):
                text("safedpa workbench", tag="h1")
                self._what = text("", "what")
                action("Rerun", self._rerun, "r", hint="what is shown here, in Rerun's viewer at the same moment")
                action("Open", self._ask, "o", hint="choose a model and recordings")
                if self._live:
                    action("Live", lambda: ui.navigate.to("/live"), "l", hint="the robots that drive now")
                action("Dark", self._toggle_dark, "d", hint="dark or light page")
                action("Keys", show_keys, "?", hint="list of keyboard shortcuts")
            self._verdict = text("", "verdict", "div").props('role=status aria-live=polite id="verdict"')
            self._progress = (
                ui.linear_progress(0.0, show_value=False).classes("progress").props('aria-label="progress"')
            )
            with ui.element("div").classes("columns") as self._columns:
                self._path = PathPanel(self._start_at, self._worst)
                self._where = WherePanel(self._axes, self._select, self._moment, self._cell)
                self._candidates = CandidatesPanel(self._add, self._reject, self._cancel)
                self._fall = ErrorReductionPanel(self._look_at, self._undo, self._save)
        self._dialog = OpenDialog(self._bench.open, self._bench.out, self._upload_store)
        self._columns.set_visibility(False)
        self._show_busy()

    def close(self) -> None:
        """The tab is gone; the bench works on."""
        self._gone = True
        self._bench.leave(self)

    async def begin(self) -> None:
        """Shows what the bench holds, or has it open what was named, or asks; does nothing in a tab that went."""
        dark = await prefers_dark()
        if self._gone:  # closed while it was asked: who begins to listen now would never leave
            return
        self._set_dark(dark)
        self._bench.listen(self, self._heard)
        if self._bench.session is not None:
            self._heard("opened")
        elif self._bench.choice.complete:
            await self._bench.begin()
        else:
            self._verdict.set_content("Choose a model and recordings of the same robot.")
            self._ask()

    def _ask(self) -> None:
        self._dialog.show(self._bench.choice)

    # what the bench tells

    def _heard(self, news: News) -> None:
        with self._columns:
            {
                "opening": self._opening,
                "opened": self._opened,
                "versions": self._versions,
                "candidates": self._show_candidates,
                "busy": self._show_busy,
                "saving": self._show_saving,
                "trouble": self._trouble,
            }[news]()

    def _opening(self) -> None:
        self._session = None
        self._columns.set_visibility(False)

    def _opened(self) -> None:
        session = self._bench.session
        if session is None:
            return
        self._session = session.view()
        seconds = sum(item.duration for item in session.runs)
        recordings = "1 recording" if len(session.runs) == 1 else f"{len(session.runs)} recordings"
        retained = f"kept in {self._bench.folder / SESSION_FILE}"
        self._what.set_content(escaped(f"{session.title} · {recordings}, {seconds:.0f} s · {retained}"))
        self._columns.set_visibility(True)
        self._show()
        self._show_busy()
        self._show_saving()

    def _versions(self) -> None:
        if self._session is not None:
            self._session.shown = None
            self._show()
            self._show_saving()

    def _show_busy(self) -> None:
        title, share = self._bench.title, self._bench.share
        self._progress.set_value(share)
        self._progress.set_visibility(bool(title))
        self._candidates.busy(f"{title}: {100 * share:.0f} %" if title else "")

    def _show_saving(self) -> None:
        self._fall.send(self._bench.warning, self._bench.saving, self._bench.notice)

    def _trouble(self) -> None:
        trouble = self._bench.trouble
        self._verdict.set_content(escaped(trouble))
        if self._bench.session is None:
            self._dialog.show(self._bench.choice)
        else:
            ui.notify(trouble, type="negative", timeout=8000, multi_line=True)

    # decisions

    async def _add(self, effect: str = "") -> None:
        await self._bench.add(effect or self._candidates.effect)

    def _reject(self, effect: str = "") -> None:
        self._bench.reject(effect or self._candidates.effect)

    def _undo(self) -> None:
        notice = self._bench.undo()
        if notice:
            ui.notify(notice)

    async def _save(self) -> None:
        await self._bench.save()

    def _cancel(self) -> None:
        self._bench.cancel()
        if self._session is not None:
            self._verdict.set_content(escaped(self._session.verdict) + " The search was cancelled; press f to go on.")

    async def _rerun(self) -> None:
        if self._session is None:
            return
        try:
            origin = await answer_of("window.location.origin")
            if not origin:
                return  # the tab is gone
            address = await self._door.open(self._session, str(origin))
        except SafedpaError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        ui.navigate.to(address, new_tab=True)

    # looking

    def _remember(self) -> None:
        """The next tab, or this one after F5, begins with what is looked at here."""
        if self._session is not None and self._bench.session is not None:
            self._bench.session.take_eye(self._session)

    def _start_at(self, window: int) -> None:
        if self._session is not None:
            last = len(self._session.comparison.windows) - 1
            self._session.start = max(0, min(last, window))
            self._remember()
            self._path.show(self._session, self._look)
            self._where.show_time(self._session, self._look)

    def _worst(self) -> None:
        if self._session is not None:
            self._start_at(self._session.worst_start())

    def _moment(self, t: float) -> None:
        if self._session is not None:
            self._start_at(window_near(self._session, t))

    def _cell(self, x: float, y: float) -> None:
        if self._session is not None:
            self._select(self._session.map().cell(x, y))

    def _axes(self, x: str, y: str) -> None:
        if self._session is not None and (x, y) != self._session.axes:
            self._session.axes = (x, y)
            self._remember()
            self._where.show(self._session, self._look)

    def _select(self, brush: Brush | None) -> None:
        if self._session is not None:
            self._session.select(brush)
            self._remember()
            self._where.show(self._session, self._look)
            self._path.show(self._session, self._look)

    def _look_at(self, number: int) -> None:
        if self._session is not None:
            self._session.look_at(number)
            self._remember()
            self._show(candidates=False)

    def _show(self, *, candidates: bool = True) -> None:
        session = self._session
        if session is None:
            return
        self._path.show(session, self._look)
        self._where.show(session, self._look)
        self._fall.show(session)
        if candidates:
            self._show_candidates()

    def _show_candidates(self) -> None:
        if self._session is not None:
            self._candidates.show(self._session)
            self._fall.show(self._session)
            self._verdict.set_content(escaped(self._session.verdict))

    def _toggle_dark(self) -> None:
        self._set_dark(self._look is LIGHT)
        self._show(candidates=False)

    def _set_dark(self, dark: bool) -> None:
        self._dark.set_value(dark)
        self._look = DARK if dark else LIGHT

    # keys

    async def _pressed(self, event: events.KeyEventArguments) -> None:
        modifiers = event.modifiers
        if not event.action.keydown or modifiers.ctrl or modifiers.alt or modifiers.meta or self._dialog.is_open:
            return
        key = str(event.key)
        start = 0 if self._session is None else self._session.start
        moves = {"ArrowLeft": -1, "ArrowRight": 1}
        if key in moves:
            self._start_at(start + moves[key])
        elif not event.action.repeat and key in self._keys():
            done = self._keys()[key]()
            if asyncio.iscoroutine(done):
                await done

    def _keys(self) -> dict[str, Callable[[], Any]]:
        return {
            "a": self._add,
            "x": self._reject,
            "u": self._undo,
            "s": self._save,
            "j": lambda: self._candidates.move(1),
            "k": lambda: self._candidates.move(-1),
            "m": self._where.worst,
            "w": self._worst,
            "c": lambda: self._select(None),
            "Escape": lambda: self._select(None),
            "f": self._bench.look_for_more,
            "o": self._ask,
            "r": self._rerun,
            "d": self._toggle_dark,
            "?": show_keys,
            **({"l": lambda: ui.navigate.to("/live")} if self._live else {}),
        }
