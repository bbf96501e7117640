"""The page for recordings: four columns that show one session, and their keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from nicegui import ui

from safedpa.errors import SafedpaError
from safedpa_services.web.upload_store import FileStore
from safedpa_services.workbench.open_dialog.dialog import OpenDialog
from safedpa_services.workbench.panels.candidates import CandidatesPanel
from safedpa_services.workbench.panels.elements import button, escaped
from safedpa_services.workbench.panels.error_map import ErrorMapPanel, window_near
from safedpa_services.workbench.panels.error_reduction import ErrorReductionPanel
from safedpa_services.workbench.panels.prediction import PredictionPanel
from safedpa_services.workbench.rerun_viewer import RerunViewerServer
from safedpa_services.workbench.session.controller import SessionController, SessionEvent
from safedpa_services.workbench.session.files import SESSION_FILE
from safedpa_services.workbench.session.selection import Selection
from safedpa_services.workbench.session.session import Session
from safedpa_services.workbench.tab import AbstractTab, run_script


class WorkbenchPage(AbstractTab):
    """One browser tab. Each tab has its own view (selection, start, axes) of the session that all tabs share."""

    title = "safedpa workbench"
    repeated_keys = ("ArrowLeft", "ArrowRight")

    def __init__(
        self,
        controller: SessionController,
        viewer_server: RerunViewerServer,
        upload_store: FileStore,
        *,
        live: bool = False,
    ) -> None:
        self._controller, self._viewer_server, self._live = controller, viewer_server, live
        self._session: Session | None = None
        """This tab's view of the shared session."""
        super().__init__()
        self._dialog = OpenDialog(controller.open, controller.out, upload_store)
        self._columns.set_visibility(False)
        self._show_busy()

    def build_header(self) -> None:
        """Builds the buttons of this page."""
        button("Rerun", self._rerun, "r", hint="show the same moment in Rerun's viewer")
        button("Open", self._show_open_dialog, "o", hint="choose a model and recordings")
        if self._live:
            button("Live", lambda: ui.navigate.to("/live"), "l", hint="show the robots that are running now")

    def build(self) -> None:
        """Builds the four columns."""
        self._progress = ui.linear_progress(0.0, show_value=False).classes("progress")
        self._progress.props('aria-label="progress"')
        with ui.element("div").classes("columns") as self._columns:
            self._prediction = PredictionPanel(self._start_at, self._worst)
            self._error_map = ErrorMapPanel(self._set_axes, self._select, self._start_near, self._select_cell)
            self._candidates = CandidatesPanel(self._add, self._reject, self._cancel)
            self._error_reduction = ErrorReductionPanel(
                self._look_at, self._undo, self._controller.save, self._controller.remove
            )

    def close(self) -> None:
        """Called when the tab was closed; the controller keeps running."""
        super().close()
        self._controller.remove_listener(self)

    async def begin(self) -> None:
        """Shows the open session, or opens the inputs of the command line, or shows the Open dialog."""
        await super().begin()
        if self._closed:  # a listener added now would never be removed
            return
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
        self.show()
        self._show_candidates()
        self._show_busy()
        self._show_saving()

    def _on_versions(self) -> None:
        if self._session is not None:
            self._session.shown = None
            self.show()
            self._show_candidates()
            self._show_saving()

    def _show_busy(self) -> None:
        title, share = self._controller.title, self._controller.share
        self._progress.set_value(share)
        self._progress.set_visibility(bool(title))
        self._candidates.show_progress(f"{title}: {100 * share:.0f} %" if title else "")

    def _show_saving(self) -> None:
        controller = self._controller
        self._error_reduction.show_save_status(controller.warning, controller.saving, controller.notice)

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

    def _cancel(self) -> None:
        self._controller.cancel()
        if self._session is not None:
            verdict = escaped(self._session.verdict)
            self._verdict.set_content(f"{verdict} The search was cancelled; press f to continue it.")

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

    def _change_view(self, change: Callable[[Session], None], show: Callable[[Session], None]) -> None:
        """Changes this tab's view and redraws a part of it; nothing happens before a session is open.

        The shared session gets the view, too: a new tab, or this one after a reload, starts with it.
        """
        if self._session is None:
            return
        change(self._session)
        if self._controller.session is not None:
            self._controller.session.copy_view_settings(self._session)
        show(self._session)

    def _start_at(self, window: int) -> None:
        self._change_view(lambda session: session.start_at(window), self._show_start)

    def _move_start(self, by: int) -> None:
        self._change_view(lambda session: session.start_at(session.start + by), self._show_start)

    def _worst(self) -> None:
        self._change_view(lambda session: session.start_at(session.worst_start()), self._show_start)

    def _start_near(self, t: float) -> None:
        self._change_view(lambda session: session.start_at(window_near(session, t)), self._show_start)

    def _select(self, selection: Selection | None) -> None:
        self._change_view(lambda session: session.select(selection), self._show_selection)

    def _select_cell(self, x: float, y: float) -> None:
        self._change_view(lambda session: session.select(session.map().cell(x, y)), self._show_selection)

    def _set_axes(self, x: str, y: str) -> None:
        if self._session is not None and (x, y) != self._session.axes:
            self._change_view(
                lambda session: session.set_axes(x, y), lambda session: self._error_map.show(session, self._theme)
            )

    def _look_at(self, number: int) -> None:
        self._change_view(lambda session: session.show_version(number), lambda _session: self.show())

    def _show_start(self, session: Session) -> None:
        self._prediction.show(session, self._theme)
        self._error_map.show_time(session, self._theme)

    def _show_selection(self, session: Session) -> None:
        self._error_map.show(session, self._theme)
        self._prediction.show(session, self._theme)

    def show(self) -> None:
        """Redraws all but the candidates."""
        if self._session is not None:
            self._show_selection(self._session)
            self._error_reduction.show(self._session)

    def _show_candidates(self) -> None:
        if self._session is not None:
            self._candidates.show(self._session)
            self._error_reduction.show(self._session)
            self._verdict.set_content(escaped(self._session.verdict))

    # keys

    @property
    def takes_keys(self) -> bool:
        """Whether the keys act: the open dialog receives them itself."""
        return not self._dialog.is_open

    def keys(self) -> Mapping[str, Callable[[], Any]]:
        """What each key does now."""
        return {
            "ArrowLeft": lambda: self._move_start(-1),
            "ArrowRight": lambda: self._move_start(1),
            "a": self._add,
            "x": self._reject,
            "u": self._undo,
            "s": self._controller.save,
            "j": lambda: self._candidates.move(1),
            "k": lambda: self._candidates.move(-1),
            "m": self._error_map.worst,
            "w": self._worst,
            "c": lambda: self._select(None),
            "Escape": lambda: self._select(None),
            "f": self._controller.start_search,
            "o": self._show_open_dialog,
            "r": self._rerun,
            **({"l": lambda: ui.navigate.to("/live")} if self._live else {}),
        }
