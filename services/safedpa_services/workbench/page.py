"""The page for recordings: four columns that show one session, and their keys."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Any

from nicegui import events, ui

from safedpa.errors import SafedpaError
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.open_dialog.dialog import OpenDialog
from safedpa_services.workbench.panels.browser import prefers_dark_mode, run_script
from safedpa_services.workbench.panels.candidates import CandidatesPanel
from safedpa_services.workbench.panels.elements import button, escaped, text
from safedpa_services.workbench.panels.error_map import ErrorMapPanel, window_near
from safedpa_services.workbench.panels.error_reduction import ErrorReductionPanel
from safedpa_services.workbench.panels.prediction import PredictionPanel
from safedpa_services.workbench.panels.shortcuts import show_keys
from safedpa_services.workbench.panels.theme import DARK, LIGHT
from safedpa_services.workbench.rerun_viewer import RerunViewerServer
from safedpa_services.workbench.session.controller import SessionController, SessionEvent
from safedpa_services.workbench.session.files import SESSION_FILE
from safedpa_services.workbench.session.selection import Selection
from safedpa_services.workbench.session.session import Session


class WorkbenchPage:
    """One browser tab. Each tab has its own view (selection, start, axes) of the session that all tabs share."""

    def __init__(
        self,
        controller: SessionController,
        viewer_server: RerunViewerServer,
        upload_store: FileStore,
        *,
        live: bool = False,
    ) -> None:
        self._controller, self._viewer_server, self._live, self._upload_store = (
            controller,
            viewer_server,
            live,
            upload_store,
        )
        self._session: Session | None = None
        """This tab's view of the shared session."""
        self._closed = False
        self._theme = LIGHT
        self._build()

    def _build(self) -> None:
        self._dark = ui.dark_mode(None)
        ui.keyboard(self._pressed, ignore=["input", "select", "textarea"], repeating=True)
        with ui.element("main").classes("workbench"):
            ui.html('<a class="skip" href="#column-3">Skip to the candidates</a>', sanitize=False)
            with ui.element("header").classes("top"):
                text("safedpa workbench", tag="h1")
                self._what = text("", "what")
                button("Rerun", self._rerun, "r", hint="show the same moment in Rerun's viewer")
                button("Open", self._show_open_dialog, "o", hint="choose a model and recordings")
                if self._live:
                    button("Live", lambda: ui.navigate.to("/live"), "l", hint="show the robots that are running now")
                button("Dark", self._toggle_dark, "d", hint="switch between dark and light page")
                button("Keys", show_keys, "?", hint="list of keyboard shortcuts")
            self._verdict = text("", "verdict", "div").props('role=status aria-live=polite id="verdict"')
            self._progress = (
                ui.linear_progress(0.0, show_value=False).classes("progress").props('aria-label="progress"')
            )
            with ui.element("div").classes("columns") as self._columns:
                self._prediction = PredictionPanel(self._start_at, self._worst)
                self._error_map = ErrorMapPanel(self._set_axes, self._select, self._start_near, self._select_cell)
                self._candidates = CandidatesPanel(self._add, self._reject, self._cancel)
                self._error_reduction = ErrorReductionPanel(self._look_at, self._undo, self._save)
        self._dialog = OpenDialog(self._controller.open, self._controller.out, self._upload_store)
        self._columns.set_visibility(False)
        self._show_busy()

    def close(self) -> None:
        """Called when the tab was closed; the controller keeps running."""
        self._closed = True
        self._controller.remove_listener(self)

    async def begin(self) -> None:
        """Shows the open session, or opens the inputs of the command line, or shows the Open dialog."""
        dark = await prefers_dark_mode()
        if self._closed:  # closed during the await: a listener added now would never be removed
            return
        self._set_dark(dark)
        self._controller.add_listener(self, self._on_event)
        if self._controller.session is not None:
            self._on_event("opened")
        elif self._controller.choice.complete:
            await self._controller.open_initial()
        else:
            self._verdict.set_content("Choose a model and recordings of the same robot.")
            self._show_open_dialog()

    def _show_open_dialog(self) -> None:
        self._dialog.show(self._controller.choice)

    # events of the controller

    def _on_event(self, event_name: SessionEvent) -> None:
        with self._columns:
            {
                "opening": self._on_opening,
                "opened": self._on_opened,
                "versions": self._on_versions,
                "candidates": self._show_candidates,
                "busy": self._show_busy,
                "saving": self._show_saving,
                "error": self._show_error,
            }[event_name]()

    def _on_opening(self) -> None:
        self._session = None
        self._columns.set_visibility(False)

    def _on_opened(self) -> None:
        session = self._controller.session
        if session is None:
            return
        self._session = session.view()
        seconds = sum(item.duration for item in session.runs)
        recordings = "1 recording" if len(session.runs) == 1 else f"{len(session.runs)} recordings"
        saved_in = f"saved in {self._controller.folder / SESSION_FILE}"
        self._what.set_content(escaped(f"{session.title} · {recordings}, {seconds:.0f} s · {saved_in}"))
        self._columns.set_visibility(True)
        self._show()
        self._show_busy()
        self._show_saving()

    def _on_versions(self) -> None:
        if self._session is not None:
            self._session.shown = None
            self._show()
            self._show_saving()

    def _show_busy(self) -> None:
        title, share = self._controller.title, self._controller.share
        self._progress.set_value(share)
        self._progress.set_visibility(bool(title))
        self._candidates.show_progress(f"{title}: {100 * share:.0f} %" if title else "")

    def _show_saving(self) -> None:
        self._error_reduction.show_save_status(
            self._controller.warning, self._controller.saving, self._controller.notice
        )

    def _show_error(self) -> None:
        error_message = self._controller.error_message
        self._verdict.set_content(escaped(error_message))
        if self._controller.session is None:
            self._dialog.show(self._controller.choice)
        else:
            ui.notify(error_message, type="negative", timeout=8000, multi_line=True)

    # decisions

    async def _add(self, effect: str = "") -> None:
        await self._controller.add(effect or self._candidates.effect)

    def _reject(self, effect: str = "") -> None:
        self._controller.reject(effect or self._candidates.effect)

    def _undo(self) -> None:
        notice = self._controller.undo()
        if notice:
            ui.notify(notice)

    async def _save(self) -> None:
        await self._controller.save()

    def _cancel(self) -> None:
        self._controller.cancel()
        if self._session is not None:
            self._verdict.set_content(
                escaped(self._session.verdict) + " The search was cancelled; press f to continue it."
            )

    async def _rerun(self) -> None:
        if self._session is None:
            return
        try:
            origin = await run_script("window.location.origin")
            if not origin:
                return  # the tab was closed
            address = await self._viewer_server.open(self._session, str(origin))
        except SafedpaError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        ui.navigate.to(address, new_tab=True)

    # looking

    def _share_view(self) -> None:
        """Copies this view to the shared session: a new tab, or this one after a reload, starts with it."""
        if self._session is not None and self._controller.session is not None:
            self._controller.session.copy_view_settings(self._session)

    def _start_at(self, window: int) -> None:
        if self._session is not None:
            last = len(self._session.comparison.windows) - 1
            self._session.start = max(0, min(last, window))
            self._share_view()
            self._prediction.show(self._session, self._theme)
            self._error_map.show_time(self._session, self._theme)

    def _worst(self) -> None:
        if self._session is not None:
            self._start_at(self._session.worst_start())

    def _start_near(self, t: float) -> None:
        if self._session is not None:
            self._start_at(window_near(self._session, t))

    def _select_cell(self, x: float, y: float) -> None:
        if self._session is not None:
            self._select(self._session.map().cell(x, y))

    def _set_axes(self, x: str, y: str) -> None:
        if self._session is not None and (x, y) != self._session.axes:
            self._session.axes = (x, y)
            self._share_view()
            self._error_map.show(self._session, self._theme)

    def _select(self, selection: Selection | None) -> None:
        if self._session is not None:
            self._session.select(selection)
            self._share_view()
            self._error_map.show(self._session, self._theme)
            self._prediction.show(self._session, self._theme)

    def _look_at(self, number: int) -> None:
        if self._session is not None:
            self._session.show_version(number)
            self._share_view()
            self._show(candidates=False)

    def _show(self, *, candidates: bool = True) -> None:
        session = self._session
        if session is None:
            return
        self._prediction.show(session, self._theme)
        self._error_map.show(session, self._theme)
        self._error_reduction.show(session)
        if candidates:
            self._show_candidates()

    def _show_candidates(self) -> None:
        if self._session is not None:
            self._candidates.show(self._session)
            self._error_reduction.show(self._session)
            self._verdict.set_content(escaped(self._session.verdict))

    def _toggle_dark(self) -> None:
        self._set_dark(self._theme is LIGHT)
        self._show(candidates=False)

    def _set_dark(self, dark: bool) -> None:
        self._dark.set_value(dark)
        self._theme = DARK if dark else LIGHT

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
            "m": self._error_map.worst,
            "w": self._worst,
            "c": lambda: self._select(None),
            "Escape": lambda: self._select(None),
            "f": self._controller.start_search,
            "o": self._show_open_dialog,
            "r": self._rerun,
            "d": self._toggle_dark,
            "?": show_keys,
            **({"l": lambda: ui.navigate.to("/live")} if self._live else {}),
        }
