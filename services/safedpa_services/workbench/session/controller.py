"""The controller that all browser tabs share: one session, its background jobs, and its file."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any, Literal

from safedpa.api.deployment import refusal_reason
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError, SafedpaError
from safedpa_services.workbench.session import jobs
from safedpa_services.workbench.session.files import (
    STEPS,
    Decision,
    SavedSession,
    absolute,
    save_model_files,
    session_folder_for,
    write_session,
)
from safedpa_services.workbench.session.inputs import InputSelection, load_inputs
from safedpa_services.workbench.session.session import Session
from safedpa_services.workbench.session.worker import StoppedError, Worker

_log = logging.getLogger(__name__)

SessionEvent = Literal["opening", "opened", "versions", "candidates", "busy", "saving", "error"]
"""What has changed; sent to every tab."""


class SessionController:
    """Opens inputs, runs jobs and applies the user's decisions; tabs are its listeners. Lives as long as the server."""

    def __init__(
        self, choice: InputSelection, out: Path, decisions: tuple[Decision, ...] = (), folder: Path | None = None
    ):
        """``out`` is the folder for new sessions; ``folder`` is that of a resumed session, with its ``decisions``."""
        self.choice, self.out, self.folder = choice, out, folder or out
        self._decisions, self._resumed = decisions, folder
        self.session: Session | None = None
        self.given: PhysicsModel | None = None
        self.title, self.share = "", 0.0
        """Title of the running job, and the share of it that is done (0 to 1)."""
        self.saving, self.notice = "", ""
        """Present step of Save, and the result of the last Save."""
        self.error_message = ""
        """Message of the last error; empty after the next successful decision."""
        self._worker, self._saver = Worker(), Worker()
        self._tabs: dict[object, Callable[[SessionEvent], None]] = {}
        self._opening: asyncio.Task[None] | None = None
        self._replaying = False
        self._tasks: set[asyncio.Task[None]] = set()

    # tabs

    def add_listener(self, tab: object, on_event: Callable[[SessionEvent], None]) -> None:
        """Registers a tab: ``on_event`` is called with every event from now on."""
        self._tabs[tab] = on_event

    def remove_listener(self, tab: object) -> None:
        """Removes a closed tab; running jobs continue."""
        self._tabs.pop(tab, None)

    def close(self) -> None:
        """Stops the background processes."""
        self._worker.stop()
        self._saver.stop()

    def _notify(self, event: SessionEvent) -> None:
        for on_event in list(self._tabs.values()):
            try:
                on_event(event)
            except Exception:  # noqa: BLE001  an error in one tab must not affect the others
                _log.exception("a tab could not show an event")

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)  # asyncio holds only weak references to tasks
        task.add_done_callback(self._tasks.discard)

    # opening

    async def open_initial(self) -> None:
        """Opens the inputs of the command line, when the first tab connects."""
        if self._opening is None and self.choice.complete:
            self._opening = asyncio.ensure_future(self._open(self.choice, self._decisions, self._resumed))
        if self._opening is not None:
            await asyncio.shield(self._opening)

    async def open(self, choice: InputSelection) -> None:
        """Opens other inputs in every tab; the previous session stays in its folder."""
        self._worker.stop()
        self._opening = asyncio.ensure_future(self._open(choice, (), None))
        await asyncio.shield(self._opening)

    async def _open(self, choice: InputSelection, decisions: tuple[Decision, ...], resumed: Path | None) -> None:
        self.choice, self.error_message, self.notice = choice, "", ""
        self.session = self.given = None
        self._notify("opening")
        self._set_progress("reading the recordings", 0.05)
        try:
            folder = self.out if resumed is None else resumed
            if resumed is None:
                folder, decisions = await asyncio.to_thread(session_folder_for, self.out, choice)
            model, runs = await asyncio.to_thread(load_inputs, choice)
            versions = await self._run_job("comparing", jobs.first_versions, model, runs, choice.horizon)
        except SafedpaError as error:
            self._set_progress("", 0.0)
            self._fail(error)
            return
        self.given, self.folder = model, folder
        self.session = Session(Path(choice.model).stem, runs, choice.horizon, versions)
        self._notify("opened")
        self._start(self._replay_and_search(decisions))

    async def _replay_and_search(self, decisions: tuple[Decision, ...]) -> None:
        """Replays earlier decisions, then searches for further candidates."""
        session = self.session
        self._replaying = bool(decisions)
        try:
            for number, (do, effect) in enumerate(decisions):
                if not await self._replay_decision(session, do, effect, f"decision {number + 1} of {len(decisions)}"):
                    return
        except SafedpaError as error:
            self._fail(InputError(f"the session could not be replayed completely: {error}"))
            return
        finally:
            self._replaying = False
        if session is self.session:
            self._save_session()
            self.start_search()

    async def _replay_decision(self, session: Session | None, do: str, effect: str, title: str) -> bool:
        """Replays one decision; returns False if other inputs were opened meanwhile."""
        if session is None or session is not self.session:
            return False
        if do == "rejected":
            session.rejected.setdefault(session.number, set()).add(effect)
            session.decisions.append((do, effect, session.number))
            return True
        version = session.present
        if do == "removed":
            without = version.step, effect, session.runs, session.horizon
            taken = await self._run_job(f"{title}: fitting without {effect}", jobs.remove_effect, *without)
            return self._took(session, taken)
        found = await self._run_job(f"{title}: searching", jobs.search, version.step, session.runs, session.horizon)
        if session is not self.session:
            return False
        session.propose(session.number, found)
        taken = session.fitted_version(effect)
        if taken is None:
            arguments = version.step, found.proposal, effect, session.runs, session.horizon
            taken = await self._run_job(f"{title}: fitting {effect}", jobs.add_candidate, *arguments)
        return self._took(session, taken)

    def _took(self, session: Session, version: jobs.SessionVersion) -> bool:
        """Makes a version the present one; returns False if other inputs were opened meanwhile."""
        if session is self.session:
            session.add(version)
            self._notify("versions")
        return session is self.session

    # the background process

    async def _run_job(self, title: str, job: Callable[..., Any], *arguments: Any) -> Any:
        self._set_progress(title, 0.05)
        try:
            return await self._worker.ask(
                job, *arguments, report_progress=lambda share: self._set_progress(title, share)
            )
        finally:
            self._set_progress("", 0.0)

    def _set_progress(self, title: str, share: float) -> None:
        self.title, self.share = title, share
        self._notify("busy")

    def _fail(self, error: SafedpaError) -> None:
        if not isinstance(error, StoppedError):
            self.error_message = str(error)
            self._notify("error")

    def start_search(self) -> None:
        """Searches for candidates after the present version, unless they are known or a job is running."""
        if self.session is not None and self.session.proposed is None and not self.title and not self._replaying:
            self._start(self._search(self.session, self.session.number))

    async def _search(self, session: Session, number: int) -> None:
        version = session.versions[number]
        try:
            found = await self._run_job("searching", jobs.search, version.step, session.runs, session.horizon)
        except SafedpaError as error:
            self._fail(error)
            return
        if session is self.session and session.present is version:
            session.propose(number, found)
            self._notify("candidates")

    def cancel(self) -> None:
        """Stops the running job; decisions are kept."""
        self._worker.stop()
        self._set_progress("", 0.0)

    # decisions

    async def add(self, effect: str) -> None:
        """Adds a candidate: the version with it becomes the present one."""
        session = self._editable_session()
        if session is None or session.proposed is None or not effect:
            return
        before, version = session.present, session.fitted_version(effect)
        try:
            if version is None:
                arguments = before.step, session.proposed.proposal, effect, session.runs, session.horizon
                version = await self._run_job(f"fitting {effect}", jobs.add_candidate, *arguments)
        except SafedpaError as error:
            self._fail(error)
            return
        if session is not self.session or session.present is not before:
            return  # another tab decided first
        session.add(version)
        self._after_decision("versions")

    async def remove(self, effect: str) -> None:
        """Removes an effect of the model: the version without it becomes the present one."""
        session = self._editable_session()
        if session is None or not effect:
            return
        self.cancel()  # a search after the present version would be of no use
        before = session.present
        try:
            arguments = before.step, effect, session.runs, session.horizon
            version = await self._run_job(f"fitting without {effect}", jobs.remove_effect, *arguments)
        except SafedpaError as error:
            self._fail(error)
            return
        if session is self.session and session.present is before:  # else another tab decided first
            session.add(version)
            self._after_decision("versions")

    def reject(self, effect: str) -> None:
        """Removes a candidate from the list."""
        session = self._editable_session()
        if session is None or not effect:
            return
        try:
            session.reject(effect)
        except InputError as error:  # another tab rejected it first
            self._fail(error)
            return
        self._after_decision("candidates")

    def undo(self) -> str:
        """Reverts the last decision; returns a message that names it."""
        session = self._editable_session()
        if session is None or not session.decisions:
            return ""
        self._worker.stop()
        self._set_progress("", 0.0)
        notice = session.undo()
        self._after_decision("versions")
        return notice

    def _editable_session(self) -> Session | None:
        """The session; None, with an error message, while earlier decisions are being replayed."""
        if self._replaying:
            self._fail(InputError("earlier decisions are being replayed; decide when that is done"))
            return None
        return self.session

    def _after_decision(self, event: SessionEvent) -> None:
        self.error_message, self.notice = "", ""
        self._save_session()
        self._notify(event)
        self.start_search()

    def _save_session(self) -> None:
        """Writes the session file."""
        if self.session is None:
            return
        decisions = tuple((do, effect) for do, effect, _ in self.session.decisions)
        try:
            write_session(SavedSession(absolute(self.choice), decisions), self.folder)
        except SafedpaError as error:
            self._fail(error)

    # saving

    @property
    def warning(self) -> str:
        """Why ``safedpa up`` would refuse the saved model; empty if it would accept it."""
        if self.given is None or self.session is None:
            return ""
        refusal = refusal_reason(self.given)
        return f"Save writes it, but 'safedpa up' will refuse it: {refusal}." if refusal else ""

    async def save(self) -> None:
        """Writes the present model in a separate process, so that a search can continue."""
        session, given = self._editable_session(), self.given
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
                report_progress=lambda s: self._show_saving(_save_step(s), ""),
            )
        except SafedpaError as error:
            self._show_saving("", "")
            self._fail(error)
        else:
            self._show_saving("", notice)

    def _show_saving(self, saving: str, notice: str) -> None:
        self.saving, self.notice = saving, notice
        self._notify("saving")


def _save_step(share: float) -> str:
    """Description of the save step at this share."""
    return [phrase for begins, phrase in STEPS if begins <= share][-1]
