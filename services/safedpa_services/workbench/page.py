"""The page: four columns over one session, its keys, and the background process behind it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any

from nicegui import background_tasks, events, ui

from safedpa.dynamics import PhysicsModel
from safedpa.errors import SafedpaError
from safedpa_services.web.shelf import Shelf
from safedpa_services.workbench import jobs
from safedpa_services.workbench.brush import Brush
from safedpa_services.workbench.elements import action, escaped, text
from safedpa_services.workbench.figures_where import window_near
from safedpa_services.workbench.help import show_keys
from safedpa_services.workbench.look import DARK, LIGHT
from safedpa_services.workbench.open_dialog import OpenDialog
from safedpa_services.workbench.panel_candidates import CandidatesPanel
from safedpa_services.workbench.panel_fall import FallPanel
from safedpa_services.workbench.panel_path import PathPanel
from safedpa_services.workbench.panel_where import WherePanel
from safedpa_services.workbench.recordings import Choice, loaded
from safedpa_services.workbench.rerun_view import RerunDoor
from safedpa_services.workbench.saving import saved
from safedpa_services.workbench.session import Session
from safedpa_services.workbench.worker import StoppedError, Worker

__all__ = ["Page"]


class Page:
    """What one browser tab shows; its process ends with it."""

    def __init__(self, choice: Choice, out: Path, door: RerunDoor, shelf: Shelf, *, live: bool = False) -> None:
        self._choice, self._out, self._door, self._live = choice, out, door, live
        self._shelf = shelf
        self._session: Session | None = None
        self._given: PhysicsModel | None = None
        self._worker = Worker()
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
                self._fall = FallPanel(self._look_at, self._undo, self._save)
        self._dialog = OpenDialog(self._opened, self._out, self._shelf)
        self._columns.set_visibility(False)
        self._busy("", 0.0)

    def close(self) -> None:
        """Ends the background process."""
        self._worker.stop()
        self._dialog.close()

    # opening

    async def begin(self) -> None:
        """Opens what the command line named, or asks."""
        if await ui.run_javascript("matchMedia('(prefers-color-scheme: dark)').matches", timeout=5.0):
            self._set_dark(True)
        else:
            self._set_dark(False)
        if self._choice.complete:
            await self._open(self._choice)
        else:
            self._verdict.set_content("Choose a model and recordings of the same robot.")
            self._ask()

    def _ask(self) -> None:
        self._dialog.show(self._choice)

    async def _opened(self, choice: Choice) -> None:
        self._worker.stop()
        await self._open(choice)

    async def _open(self, choice: Choice) -> None:
        self._choice = choice
        self._columns.set_visibility(False)
        self._busy("reading the recordings", 0.05)
        try:
            model, runs = await asyncio.to_thread(loaded, choice)
            versions = await self._ask_worker("comparing", jobs.opened, model, runs, choice.horizon)
        except SafedpaError as error:
            self._busy("", 0.0)
            self._verdict.set_content(escaped(str(error)))
            self._dialog.show(choice)
            return
        self._given = model
        self._session = Session(Path(choice.model).stem, runs, choice.horizon, versions)
        seconds = sum(item.duration for item in runs)
        recordings = "1 recording" if len(runs) == 1 else f"{len(runs)} recordings"
        self._what.set_content(escaped(f"{self._session.title} · {recordings}, {seconds:.0f} s"))
        self._columns.set_visibility(True)
        self._show()
        self._look_for_more()

    # the background process

    async def _ask_worker(self, title: str, job: Callable[..., Any], *arguments: Any) -> Any:
        self._busy(title, 0.05)
        try:
            return await self._worker.ask(job, *arguments, tell=lambda share: self._busy(title, share))
        finally:
            self._busy("", 0.0)

    def _busy(self, title: str, share: float) -> None:
        self._progress.set_value(share)
        self._progress.set_visibility(bool(title))
        self._candidates.busy(f"{title}: {100 * share:.0f} %" if title else "")

    def _failed(self, error: SafedpaError) -> None:
        if not isinstance(error, StoppedError):
            self._verdict.set_content(escaped(str(error)))
            ui.notify(str(error), type="negative", timeout=8000, multi_line=True)

    def _look_for_more(self) -> None:
        """Searches after the present version, unless that was done."""
        if self._session is not None and self._session.proposed is None:
            background_tasks.create(self._search(self._session, self._session.number))

    async def _search(self, session: Session, number: int) -> None:
        version = session.versions[number]
        with self._columns:
            try:
                found = await self._ask_worker("searching", jobs.search, version.step, session.runs, session.horizon)
            except SafedpaError as error:
                self._failed(error)
                return
            if session is self._session and session.present is version:
                session.propose(number, found)
                self._show_candidates()

    def _cancel(self) -> None:
        self._worker.stop()
        self._busy("", 0.0)
        if self._session is not None:
            self._verdict.set_content(escaped(self._session.verdict) + " The search was cancelled; press f to go on.")

    # decisions

    async def _add(self, effect: str = "") -> None:
        session, effect = self._session, effect or self._candidates.effect
        if session is None or session.proposed is None or not effect:
            return
        before, version = session.present, session.settled(effect)
        if version is None:
            arguments = session.present.step, session.proposed.proposal, effect, session.runs, session.horizon
            try:
                version = await self._ask_worker(f"fitting {effect}", jobs.taken, *arguments)
            except SafedpaError as error:
                self._failed(error)
                return
        if session.present is not before or session is not self._session:
            return  # another decision was quicker
        session.add(version)
        self._show()
        self._look_for_more()

    def _reject(self, effect: str = "") -> None:
        effect = effect or self._candidates.effect
        if self._session is not None and effect:
            self._session.reject(effect)
            self._show_candidates()

    def _undo(self) -> None:
        if self._session is None or not self._session.decided:
            return
        self._worker.stop()
        said = self._session.undo()
        self._show()
        ui.notify(said)
        self._look_for_more()

    async def _save(self) -> None:
        if self._session is None or self._given is None:
            return
        self._worker.stop()  # a search that is under way begins anew afterwards
        try:
            said = await self._ask_worker(
                "final numbers", saved, self._session.present.step, self._session.runs, self._given, self._out
            )
        except SafedpaError as error:
            self._failed(error)
            return
        ui.notify(said, type="positive", timeout=12000, multi_line=True, close_button="Close")
        self._look_for_more()

    async def _rerun(self) -> None:
        if self._session is None:
            return
        try:
            origin = await ui.run_javascript("window.location.origin", timeout=5.0)
            address = await self._door.open(self._session, str(origin))
        except (SafedpaError, TimeoutError) as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return
        ui.navigate.to(address, new_tab=True)

    # looking

    def _start_at(self, window: int) -> None:
        if self._session is not None:
            last = len(self._session.comparison.windows) - 1
            self._session.start = max(0, min(last, window))
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
            self._where.show(self._session, self._look)

    def _select(self, brush: Brush | None) -> None:
        if self._session is not None:
            self._session.select(brush)
            self._where.show(self._session, self._look)
            self._path.show(self._session, self._look)

    def _look_at(self, number: int) -> None:
        if self._session is not None:
            self._session.look_at(number)
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
            "f": self._look_for_more,
            "o": self._ask,
            "r": self._rerun,
            "d": self._toggle_dark,
            "?": show_keys,
            **({"l": lambda: ui.navigate.to("/live")} if self._live else {}),
        }
