"""The bench behind every tab: one session, its computations, and its file. It lives as long as the server."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Literal

from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, SafedpaError
from safedpa_services.driving import refusal_reason
from safedpa_services.workbench import jobs
from safedpa_services.workbench.recordings import InputSelection, load_inputs
from safedpa_services.workbench.session import Session
from safedpa_services.workbench.session_files import (
    STEPS,
    Decision,
    SavedSession,
    absolute,
    save_model_files,
    session_folder_for,
    write_session,
)
from safedpa_services.workbench.worker import StoppedError, Worker

__all__ = ["Bench", "News"]

_log = logging.getLogger(__name__)

News = Literal["opening", "opened", "versions", "candidates", "busy", "saving", "trouble"]
"""What changed, told to every tab."""


class Bench:
    """What is opened and decided; tabs listen to it and hand the person's decisions on."""

    def __init__(
        self, choice: InputSelection, out: Path, decisions: tuple[Decision, ...] = (), folder: Path | None = None
    ):
        """``out``: the folder for sessions; ``folder``: that of this one, where it is a session that goes on."""
        self.choice, self.out, self.folder = choice, out, folder or out
        self._decisions, self._resumed = decisions, folder
        self.session: Session | None = None
        self.given: PhysicsModel | None = None
        self.title, self.share = "", 0.0
        """What is computed, and how much of it is done."""
        self.saving, self.notice = "", ""
        """What Save does now, and what came of it."""
        self.trouble = ""
        """What went wrong last, in words; empty once something went well."""
        self._worker, self._saver = Worker(), Worker()
        self._tabs: dict[object, Callable[[News], None]] = {}
        self._opening: asyncio.Task[None] | None = None
        self._replaying = False
        self._tasks: set[asyncio.Task[None]] = set()

    # tabs

    def listen(self, tab: object, heard: Callable[[News], None]) -> None:
        """Tells a tab from now on what changes."""
        self._tabs[tab] = heard

    def leave(self, tab: object) -> None:
        """The tab is gone; the work goes on."""
        self._tabs.pop(tab, None)

    def close(self) -> None:
        """Ends the background processes."""
        self._worker.stop()
        self._saver.stop()

    def _report(self, news: News) -> None:
        for heard in list(self._tabs.values()):
            try:
                heard(news)
            except Exception:  # noqa: BLE001  whatever happened in one tab: the others hear, and what was decided goes on
                _log.exception("a tab could not show what is new")

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)  # else no one holds it
        task.add_done_callback(self._tasks.discard)

    # opening

    async def begin(self) -> None:
        """Opens what the command line named, at the first tab."""
        if self._opening is None and self.choice.complete:
            self._opening = asyncio.ensure_future(self._open(self.choice, self._decisions, self._resumed))
        if self._opening is not None:
            await asyncio.shield(self._opening)

    async def open(self, choice: InputSelection) -> None:
        """Opens something else in every tab; the session before stays in its folder."""
        self._worker.stop()
        self._opening = asyncio.ensure_future(self._open(choice, (), None))
        await asyncio.shield(self._opening)

    async def _open(self, choice: InputSelection, decisions: tuple[Decision, ...], resumed: Path | None) -> None:
        self.choice, self.trouble, self.notice = choice, "", ""
        self.session = self.given = None
        self._report("opening")
        self._busy("reading the recordings", 0.05)
        try:
            folder = self.out if resumed is None else resumed
            if resumed is None:
                folder, decisions = await asyncio.to_thread(session_folder_for, self.out, choice)
            model, runs = await asyncio.to_thread(load_inputs, choice)
            versions = await self._ask("comparing", jobs.opened, model, runs, choice.horizon)
        except SafedpaError as error:
            self._busy("", 0.0)
            self._fail(error)
            return
        self.given, self.folder = model, folder
        self.session = Session(Path(choice.model).stem, runs, choice.horizon, versions)
        self._report("opened")
        self._start(self._go_on(decisions))

    async def _go_on(self, decisions: tuple[Decision, ...]) -> None:
        """Does again what was decided, then searches for more."""
        session = self.session
        self._replaying = bool(decisions)
        try:
            for number, (do, effect) in enumerate(decisions):
                if not await self._again(session, do, effect, f"decision {number + 1} of {len(decisions)}"):
                    return
        except SafedpaError as error:
            self._fail(InputError(f"the session could not be replayed whole: {error}"))
            return
        finally:
            self._replaying = False
        if session is self.session:
            self._keep()
            self.look_for_more()

    async def _again(self, session: Session | None, do: str, effect: str, title: str) -> bool:
        """One decision again; False where something else was opened meanwhile."""
        if session is None or session is not self.session:
            return False
        if do == "rejected":
            session.rejected.setdefault(session.number, set()).add(effect)
            session.decided.append((do, effect, session.number))
            return True
        version = session.present
        found = await self._ask(f"{title}: searching", jobs.search, version.step, session.runs, session.horizon)
        if session is not self.session:
            return False
        session.propose(session.number, found)
        taken = session.settled(effect)
        if taken is None:
            arguments = version.step, found.proposal, effect, session.runs, session.horizon
            taken = await self._ask(f"{title}: fitting {effect}", jobs.add_candidate, *arguments)
        if session is self.session:
            session.add(taken)
            self._report("versions")
        return session is self.session

    # the background process

    async def _ask(self, title: str, job: Callable[..., Any], *arguments: Any) -> Any:
        self._busy(title, 0.05)
        try:
            return await self._worker.ask(job, *arguments, report_progress=lambda share: self._busy(title, share))
        finally:
            self._busy("", 0.0)

    def _busy(self, title: str, share: float) -> None:
        self.title, self.share = title, share
        self._report("busy")

    def _fail(self, error: SafedpaError) -> None:
        if not isinstance(error, StoppedError):
            self.trouble = str(error)
            self._report("trouble")

    def look_for_more(self) -> None:
        """Searches after the present version, unless that was done or something is computed."""
        if self.session is not None and self.session.proposed is None and not self.title and not self._replaying:
            self._start(self._search(self.session, self.session.number))

    async def _search(self, session: Session, number: int) -> None:
        version = session.versions[number]
        try:
            found = await self._ask("searching", jobs.search, version.step, session.runs, session.horizon)
        except SafedpaError as error:
            self._fail(error)
            return
        if session is self.session and session.present is version:
            session.propose(number, found)
            self._report("candidates")

    def cancel(self) -> None:
        """Ends what is computed; what was decided stays."""
        self._worker.stop()
        self._busy("", 0.0)

    # decisions

    async def add(self, effect: str) -> None:
        """Goes on with a candidate."""
        session = self._ready()
        if session is None or session.proposed is None or not effect:
            return
        before, version = session.present, session.settled(effect)
        try:
            if version is None:
                arguments = before.step, session.proposed.proposal, effect, session.runs, session.horizon
                version = await self._ask(f"fitting {effect}", jobs.add_candidate, *arguments)
        except SafedpaError as error:
            self._fail(error)
            return
        if session is not self.session or session.present is not before:
            return  # another decision was quicker
        session.add(version)
        self._decided("versions")

    def reject(self, effect: str) -> None:
        """Takes a candidate off the list."""
        session = self._ready()
        if session is None or not effect:
            return
        try:
            session.reject(effect)
        except InputError as error:  # another tab was quicker
            self._fail(error)
            return
        self._decided("candidates")

    def undo(self) -> str:
        """Takes the last decision back and says which."""
        session = self._ready()
        if session is None or not session.decided:
            return ""
        self._worker.stop()
        self._busy("", 0.0)
        notice = session.undo()
        self._decided("versions")
        return notice

    def _ready(self) -> Session | None:
        """The session, unless what was decided before is still being done again."""
        if self._replaying:
            self._fail(InputError("what was decided before is being computed again; decide when that is done"))
            return None
        return self.session

    def _decided(self, news: News) -> None:
        self.trouble, self.notice = "", ""
        self._keep()
        self._report(news)
        self.look_for_more()

    def _keep(self) -> None:
        """Writes the session's file."""
        if self.session is None:
            return
        decisions = tuple((do, effect) for do, effect, _ in self.session.decided)
        try:
            write_session(SavedSession(absolute(self.choice), decisions), self.folder)
        except SafedpaError as error:
            self._fail(error)

    # saving

    @property
    def warning(self) -> str:
        """What is to be known before Save: why ``safedpa up`` would refuse the model; empty where it would not."""
        if self.given is None or self.session is None:
            return ""
        refusal = refusal_reason(self.given)
        return f"Save writes it, but 'safedpa up' will refuse it: {refusal}." if refusal else ""

    async def save(self) -> None:
        """Writes the present model, in a process of its own: a search goes on meanwhile."""
        session, given = self._ready(), self.given
        if session is None or given is None or self.saving:
            return
        self._show_saving(STEPS[0][1], "")
        try:
            notice = await self._saver.ask(
                save_model_files,
                session.present.step,
                session.runs,
                given,
                self.folder,
                report_progress=lambda s: self._show_saving(_step(s), ""),
            )
        except SafedpaError as error:
            self._show_saving("", "")
            self._fail(error)
        else:
            self._show_saving("", notice)

    def _show_saving(self, saving: str, notice: str) -> None:
        self.saving, self.notice = saving, notice
        self._report("saving")


def _step(share: float) -> str:
    """What is done from this share on."""
    return [phrase for begins, phrase in STEPS if begins <= share][-1]
