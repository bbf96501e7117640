"""The dialog that chooses a model, recordings and a column map, with an editable line for each quantity."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

from nicegui import events, ui

from safedpa.disk import why_not_written
from safedpa.dynamics import PhysicsModel, load_model, shipped_models
from safedpa.errors import SafedpaError
from safedpa.limits import limit, readable
from safedpa.records import ColumnMap, load_column_map
from safedpa.records.column_map.column_map import native_map
from safedpa.records.column_map.file import shipped_column_maps
from safedpa.records.column_map.form import (
    DERIVED,
    QuantityForm,
    guess_columns,
    lines_of,
    map_text,
    units_for,
)
from safedpa.records.readers.preview import RowPreview, raw_rows
from safedpa.records.writers.tables import atomic_path
from safedpa_services.web.upload_store import RECORDINGS, FileStore
from safedpa_services.workbench.open_dialog.file_preview import RecordingCheck, check_recording
from safedpa_services.workbench.panels.elements import button, escaped, on_render, set_accessible_name, text
from safedpa_services.workbench.session.inputs import EditedColumnMap, InputSelection

_Result = TypeVar("_Result")
_GUESSED = "guessed from the names"
_NATIVE = "native names"
_SHOWN_UPLOADS = 5
"""Number of latest uploads that the dialog lists."""
_PREPARE_UPLOAD = """(node) => {
  const input = node.el?.querySelector?.('input[type=file]');
  if (!input) return;
  input.setAttribute('aria-label', 'upload recordings');
  input.setAttribute('tabindex', '0');
  const sign = input.closest('a');
  if (sign) { sign.removeAttribute('role'); sign.removeAttribute('tabindex'); sign.removeAttribute('href'); }
  window.takeRecordings = (files) => node.component.refs.qRef.addFiles(files);
  if (window.droppedRecordings) { window.takeRecordings(window.droppedRecordings); window.droppedRecordings = null; }
}"""
"""Moves the keyboard focus from the link that Quasar draws to the file input itself, and gives it a name.

Also uploads files that were dropped elsewhere on the page, or before the dialog was open."""
_DROP_SCRIPT = """<script>
document.addEventListener('dragover', (event) => {
  if ([...event.dataTransfer.types].includes('Files')) event.preventDefault();
});
document.addEventListener('drop', (event) => {
  if (event.defaultPrevented || !event.dataTransfer.files.length) return;
  event.preventDefault();
  const files = [...event.dataTransfer.files];
  if (document.querySelector('.q-uploader')) { window.takeRecordings(files); return; }
  window.droppedRecordings = files;
  emitEvent('recordings_dropped');
});
</script>"""
"""Uploads files that are dropped on the page; by default the browser would replace the page by the file."""


def _reports_errors(method: Callable[[OpenDialog], _Result]) -> Callable[[OpenDialog], _Result | None]:
    """Shows an error in the dialog instead of raising it; the result is then None."""

    @wraps(method)
    def reporting(dialog: OpenDialog) -> _Result | None:
        try:
            return method(dialog)
        except SafedpaError as error:
            dialog.report(str(error))
            return None

    return reporting


class OpenDialog:
    """Chooses model, recordings and columns; shows a preview in SI units and the quality checks before opening."""

    def __init__(
        self, on_open: Callable[[InputSelection], Awaitable[None]], out: Path, upload_store: FileStore
    ) -> None:
        self._on_open, self._out, self._upload_store = on_open, out, upload_store
        self._choice = InputSelection()
        self._raw = RowPreview((), ())
        self._uploads = out / "uploads"
        self._upload_messages: list[str] = []
        self._checks = 0
        self._tasks: set[asyncio.Task[None]] = set()
        ui.add_head_html(_DROP_SCRIPT)
        ui.on("recordings_dropped", self._on_dropped)
        with ui.dialog().props("aria-label=Open") as self._dialog, ui.card().classes("wide"):
            with ui.element("div").classes("row dialog-title"):
                text("Open a model and recordings", tag="h2")
                button("Open", self._open, main=True)
                button("Save column map", self._save_map, hint="write the column map to a file")
                button("Cancel", self._dialog.close)
            self._files()
            self._columns()
            self._check = ui.element("div").props("aria-live=polite").style("width: 100%")

    def _files(self) -> None:
        with ui.element("div").classes("row").style("width: 100%; align-items: flex-start"):
            self._model = ui.input("Model: a file or a shipped name", autocomplete=sorted(shipped_models()))
            self._model.props("dense outlined").style("flex: 1").on("blur", self._refresh)
            self._horizon = ui.number("Horizon [s]", value=1.0, min=0.05, max=60.0, step=0.1)
            self._horizon.props("dense outlined").style("width: 110px")
        with ui.element("div").classes("row").style("width: 100%; align-items: flex-start"):
            kinds = " ".join(RECORDINGS)
            self._paths = ui.textarea(f"Recordings on the server, one path or pattern per line ({kinds})")
            self._paths.props("dense outlined autogrow").style("flex: 1").on("blur", self._refresh)
            upload = ui.upload(label="or drag them here", multiple=True, auto_upload=True, on_upload=self._on_uploaded)
            upload.on_rejected(self._on_rejected)
            upload.props(f"max-file-size={limit('upload_bytes')} max-files={limit('uploads')}")
            upload.props(f'flat bordered accept="{",".join(RECORDINGS)}" aria-label="upload recordings"')
            upload.style("width: 250px; max-height: 110px")
            on_render(upload, _PREPARE_UPLOAD)
        self._uploaded_files = text("", "fine", "div").props("role=status aria-live=polite")

    def _columns(self) -> None:
        with ui.element("div").classes("row").style("width: 100%"):
            text("Columns:", "quiet")
            options = [_NATIVE, _GUESSED, *shipped_column_maps()]
            self._map = ui.select(options, value=_NATIVE, on_change=self._map_chosen)
            set_accessible_name(self._map.props("dense outlined options-dense").classes("flat"), "column map")
            self._message = text("", "quiet")
        self._columns_table = ColumnsTable(self._check_now)

    @property
    def is_open(self) -> bool:
        """Whether the dialog is open; it then receives all keys."""
        return bool(self._dialog.value)

    def show(self, choice: InputSelection) -> asyncio.Task[None]:
        """Opens the dialog with the present inputs; the task ends when the first recording was read."""
        self._choice = choice
        self._model.value = choice.model
        self._paths.value = "\n".join(choice.runs)
        self._horizon.value = choice.horizon
        if isinstance(choice.columns, str) and choice.columns not in self._map.options:
            self._map.set_options([*self._map.options, choice.columns])
        if isinstance(choice.columns, str):
            self._map.value = choice.columns
        self._dialog.open()
        return self._start(self._refresh())

    def _start(self, story: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        """Starts a task and keeps it until it ends, since the event loop has only weak references to tasks."""
        task = asyncio.get_running_loop().create_task(story)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    def _on_rejected(self) -> None:
        """Reports that the browser refused to send a file."""
        most = f"{limit('upload_bytes') / 1e6:.0f} MB"
        self.report(
            f"Not uploaded: wanted recordings ({' '.join(RECORDINGS)}) of at most {most}, {limit('uploads')} at most"
        )

    def _on_dropped(self) -> None:
        """Opens the dialog for files that were dropped on the page; it uploads them once it is drawn."""
        if not self.is_open:
            self.show(self._choice)

    async def _on_uploaded(self, event: events.UploadEventArguments) -> None:
        """Saves an uploaded file below the session folder, because a resumed session needs its recordings."""
        suffix = Path(event.file.name).suffix.lower()
        count = len(list(self._uploads.glob("*"))) if self._uploads.is_dir() else 0
        if count >= limit("uploads") or suffix not in RECORDINGS:
            self.report(
                f"{event.file.name}: not uploaded; wanted a recording ({' '.join(RECORDINGS)}), and at most "
                f"{limit('uploads')} files in {self._uploads}"
            )
            return
        path: Path | None = None
        try:
            path = self._create_upload_file(count + 1, f"{_safe_stem(event.file.name)}{suffix}")
            await event.file.save(path)
        except OSError as error:
            if path is not None:
                with suppress(OSError):  # remove the incomplete file
                    path.unlink()
            why = why_not_written(error)
            self.report(f"{event.file.name}: cannot be saved in {self._uploads} ({why}), or choose another --out")
            return
        self._upload_store = self._upload_store.with_folder(self._uploads)
        self._paths.value = "\n".join([*str(self._paths.value or "").splitlines(), str(path)])
        self._upload_messages.append(f"Uploaded: {event.file.name}, {path.stat().st_size / 1e6:.2g} MB, to {path}")
        self._uploaded_files.set_content("<br>".join(map(escaped, self._upload_messages[-_SHOWN_UPLOADS:])))
        await self._refresh()

    def _create_upload_file(self, number: int, name: str) -> Path:
        """Creates a new empty file for an upload; simultaneous uploads, also of other tabs, get different files."""
        self._uploads.mkdir(mode=0o700, parents=True, exist_ok=True)
        while True:
            path = self._uploads / f"{number:03d}_{name}"
            try:
                path.touch(exist_ok=False)
            except FileExistsError:
                number += 1
                continue
            return path

    # model, recordings and columns; these raise SafedpaError for what cannot be opened

    def _loaded_model(self) -> PhysicsModel | None:
        name = str(self._model.value or "")
        return load_model(self._upload_store.model(name, shipped_models())) if name else None

    def _selected_paths(self) -> list[str]:
        """Returns the named paths with patterns expanded."""
        return self._upload_store.recordings(str(self._paths.value or "").splitlines())

    async def _refresh(self) -> None:
        """Reads the columns of the first file, in a thread, and chooses a column map that fits them."""
        try:
            model, paths = self._loaded_model(), self._selected_paths()
            if model is None or not paths:
                return
            self._raw = await asyncio.to_thread(raw_rows, paths[0])
        except SafedpaError as error:
            self.report(str(error))
            return
        native = set(native_map(model.system).sources) <= set(self._raw.names)
        if self._raw.names and not native and self._map.value == _NATIVE:
            self._map.value = self._matching_shipped_map(model) or _GUESSED  # calls _map_chosen
            return
        self._map_chosen()

    def _matching_shipped_map(self, model: PhysicsModel) -> str:
        """Name of a shipped map whose columns the file has; empty if there is none."""
        for name in shipped_column_maps():
            columns = load_column_map(name)
            if columns.robot == model.system.name and set(columns.sources) <= set(self._raw.names):
                return name
        return ""

    @_reports_errors
    def _map_chosen(self) -> None:
        model = self._loaded_model()
        if model is None:
            return
        self._message.set_content(escaped("" if self._raw.names else "a bus recording needs no column map"))
        self._columns_table.show(self._lines(model), self._raw)
        self._check_now()

    def _lines(self, model: PhysicsModel) -> list[QuantityForm]:
        if not self._raw.names:
            return []
        if self._map.value == _GUESSED:
            return guess_columns(model.system, self._raw.names)
        base_map = self._base_map()
        return lines_of(model.system, native_map(model.system) if base_map is None else base_map)

    def _base_map(self) -> ColumnMap | None:
        return None if self._map.value in (_NATIVE, _GUESSED) else load_column_map(str(self._map.value))

    def _edited_map(self, model: PhysicsModel) -> EditedColumnMap | None:
        """The map that the table describes; None for a bus recording. Raises ColumnMapError if it is invalid."""
        if not self._raw.names:
            return None
        base_map = str(self._map.value) if self._base_map() is not None else ""
        edited = EditedColumnMap(map_text(model.system, self._columns_table.lines), base_map)
        edited.columns  # noqa: B018  raises ColumnMapError if the table is invalid
        return edited

    @_reports_errors
    def _check_now(self) -> None:
        """Reads the first recording as the diagnosis would, in a thread; the latest check is shown."""
        model, paths = self._loaded_model(), self._selected_paths()
        if model is None or not paths:
            return
        edited = self._edited_map(model)
        columns = None if edited is None else edited.columns
        self._checks += 1
        self._start(self._check_recording(paths, model, columns, self._checks))

    async def _check_recording(
        self, paths: list[str], model: PhysicsModel, columns: ColumnMap | None, number: int
    ) -> None:
        found = await asyncio.to_thread(check_recording, paths[0], model.system, columns)
        if number == self._checks and not self._check.is_deleted:
            self._show_check(Path(paths[0]).name, len(paths), found, model)

    def report(self, problem: str) -> None:
        """Shows a problem in place of the preview."""
        self._check.clear()
        with self._check:
            text(problem, "problem", "div")

    def _show_check(self, name: str, files: int, found: RecordingCheck, model: PhysicsModel) -> None:
        if found.problem:
            self.report(found.problem)
            return
        units = {variable.name: variable.unit for variable in (*model.system.state, *model.system.action)} | {"t": "s"}
        more = f" (first of {files} files)" if files > 1 else ""
        self._check.clear()
        with self._check:
            text(f"{name}{more}: {found.sentence}", "fine", "div")
            for message in found.findings:
                text(f"• {message}", "quiet", "div")
            table = _preview_table([f"{n} [{units[n]}]" for n in found.names], found.rows)
            ui.html(table, sanitize=False).classes("preview")

    # buttons

    async def _open(self) -> None:
        choice = self._chosen()
        if choice is not None:
            self._dialog.close()
            await self._on_open(choice)

    @_reports_errors
    def _chosen(self) -> InputSelection | None:
        """Returns the inputs to open; None, with a message, if they are incomplete."""
        model, paths = self._loaded_model(), self._selected_paths()
        if not paths:
            raise SafedpaError("Choose a model and at least one recording.")
        if model is None:
            raise SafedpaError("Choose a model.")
        columns, horizon = self._edited_map(model), float(self._horizon.value)
        return replace(self._choice, model=str(self._model.value), columns=columns, horizon=horizon).with_runs(paths)

    @_reports_errors
    def _save_map(self) -> None:
        model = self._loaded_model()
        if model is None or not self._columns_table.lines:
            return
        path = self._out / "columns.toml"
        self._edited_map(model)
        with atomic_path(path) as temporary:
            temporary.write_text(map_text(model.system, self._columns_table.lines), encoding="utf-8")
        ui.notify(f"Written: {path}", type="positive")


def _safe_stem(name: str) -> str:
    """Stem of an uploaded file name, reduced to safe characters."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name).stem)[:60]


def _preview_table(names: list[str], rows: Any) -> str:
    head = "".join(f"<th>{escaped(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{value:.4g}</td>" for value in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


class ColumnsTable:
    """Editable table with source, unit, scale, offset and sign of every quantity; calls ``on_change`` after an edit."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self.lines: list[QuantityForm] = []
        self._raw = RowPreview((), ())
        self._grid = ui.element("div").classes("map-grid")

    def show(self, lines: list[QuantityForm], raw: RowPreview) -> None:
        """Redraws the table."""
        self.lines, self._raw = list(lines), raw
        self._grid.clear()
        if not lines:
            return
        with self._grid:
            for title in ("quantity", "column of the file", "unit", "scale", "offset [SI]", "flip", "first values"):
                text(title, "head")
            for index, line in enumerate(lines):
                self._line(index, line)

    def _line(self, index: int, line: QuantityForm) -> None:
        text(f"{line.target} [{line.si}]")
        columns = [*([DERIVED] if line.derivation or line.source == DERIVED else []), *self._raw.names]
        if line.source and line.source not in columns:
            columns.append(line.source)
        self._choice(index, "source", columns, line.source or None, f"column for {line.target}")
        units = units_for(line.si)
        self._choice(index, "unit", units, line.unit or line.si, f"unit of {line.target}")
        self._number(index, "scale", line.scale, f"factor of {line.target}")
        self._number(index, "offset", line.offset, f"offset of {line.target}")
        box = ui.checkbox(value=line.flip, on_change=lambda e: self._changed(index, "flip", bool(e.value)))
        box.props(f'dense aria-label="flip the sign of {line.target}"')
        text(self._first_values(line.source), "quiet one-line")

    def _choice(self, index: int, field: str, options: list[str], value: str | None, title: str) -> None:
        known = value if value in options else None
        # topic names of a bag can be long
        shown = {option: readable(option, limit("name_letters")) for option in options}
        box = ui.select(shown, value=known, on_change=lambda e: self._changed(index, field, str(e.value or "")))
        set_accessible_name(box.props("dense outlined options-dense").classes("flat"), title)

    def _number(self, index: int, field: str, value: float, title: str) -> None:
        box = ui.number(value=value, on_change=lambda e: self._changed(index, field, e.value))
        set_accessible_name(box.props("dense outlined debounce=400").classes("flat"), title)

    def _changed(self, index: int, field: str, value: Any) -> None:
        if value is None:
            return
        change: dict[str, Any] = {field: float(value) if field in ("scale", "offset") else value}
        if field == "source":
            change["original"] = None  # it describes the previous source
        self.lines[index] = replace(self.lines[index], **change)
        if field == "source":
            self.show(self.lines, self._raw)
        self._on_change()

    def _first_values(self, source: str) -> str:
        if source not in self._raw.names:
            return ""
        at = self._raw.names.index(source)
        return ", ".join(row[at][:9] for row in self._raw.rows[:3] if at < len(row))
