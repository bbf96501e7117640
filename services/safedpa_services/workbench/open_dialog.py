"""The dialog that chooses a model, recordings, and how their columns are read: a line for each quantity."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from nicegui import events, ui

from safedpa.disk import why_not_written
from safedpa.dynamics import PhysicsModel, load_model, shipped_models
from safedpa.errors import SafedpaError
from safedpa.limits import limit, readable
from safedpa.records import ColumnMap, load_column_map
from safedpa.records.column_map.column_map import native_map
from safedpa.records.column_map.file import shipped_column_maps
from safedpa.records.writers.tables import atomic_path
from safedpa_services.web.upload_store import RECORDINGS, FileStore
from safedpa_services.workbench.column_form import DERIVED, QuantityForm, guess_columns, lines_of, map_text, units_for
from safedpa_services.workbench.elements import action, escaped, named, on_change_of, text
from safedpa_services.workbench.file_preview import RawRows, RecordingCheck, check_recording, raw_rows
from safedpa_services.workbench.recordings import EditedColumnMap, InputSelection

__all__ = ["ColumnsTable", "OpenDialog"]

_GUESSED = "guessed from the names"
_NATIVE = "native names"
_REPORTED = 5
"""Uploads that the dialog names, the latest."""
_NAME_UPLOAD = """(node) => {
  const input = node.el?.querySelector?.('input[type=file]');
  if (!input) return;
  input.setAttribute('aria-label', 'upload recordings');
  input.setAttribute('tabindex', '0');
  const sign = input.closest('a');
  if (sign) { sign.removeAttribute('role'); sign.removeAttribute('tabindex'); sign.removeAttribute('href'); }
  window.takeRecordings = (files) => node.component.refs.qRef.addFiles(files);
  if (window.droppedRecordings) { window.takeRecordings(window.droppedRecordings); window.droppedRecordings = null; }
}"""
"""The framework draws a link around the control; the control itself is what the keyboard reaches. And it takes what was
dropped next to it, or before the dialog was there."""
_DROPS = """<script>
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
"""A browser shows a file that is dropped on a page in the place of that page; here the dialog takes it instead."""


class OpenDialog:
    """Model, files, columns; a preview in SI units and what the quality checks say, before anything is opened."""

    def __init__(
        self, on_open: Callable[[InputSelection], Awaitable[None]], out: Path, upload_store: FileStore
    ) -> None:
        self._on_open, self._out, self._upload_store = on_open, out, upload_store
        self._choice = InputSelection()
        self._raw = RawRows((), ())
        self._uploads = out / "uploads"
        self._retained: list[str] = []
        ui.add_head_html(_DROPS)
        ui.on("recordings_dropped", self._dropped)
        with ui.dialog().props("aria-label=Open") as self._dialog, ui.card().classes("wide"):
            with ui.element("div").classes("row dialog-title"):
                text("Open a model and recordings", tag="h2")
                action("Open", self._open, main=True)
                action("Save column map", self._save_map, hint="write the column map as a file")
                action("Cancel", self._dialog.close)
            self._files()
            self._columns()
            self._check = ui.element("div").props("aria-live=polite").style("width: 100%")

    def _files(self) -> None:
        with ui.element("div").classes("row").style("width: 100%; align-items: flex-start"):
            self._model = ui.input("Model: a file, or one that ships", autocomplete=sorted(shipped_models()))
            self._model.props("dense outlined").style("flex: 1").on("blur", self._refresh)
            self._horizon = ui.number("Horizon [s]", value=1.0, min=0.05, max=60.0, step=0.1)
            self._horizon.props("dense outlined").style("width: 110px")
        with ui.element("div").classes("row").style("width: 100%; align-items: flex-start"):
            self._paths = ui.textarea(f"Recordings here, one path or pattern a line ({' '.join(RECORDINGS)})")
            self._paths.props("dense outlined autogrow").style("flex: 1").on("blur", self._refresh)
            upload = ui.upload(label="or drag them here", multiple=True, auto_upload=True, on_upload=self._uploaded)
            upload.on_rejected(self._rejected)
            upload.props(f"max-file-size={limit('upload_bytes')} max-files={limit('uploads')}")
            upload.props(f'flat bordered accept="{",".join(RECORDINGS)}" aria-label="upload recordings"')
            upload.style("width: 250px; max-height: 110px")
            on_change_of(upload, _NAME_UPLOAD)
        self._taken = text("", "fine", "div").props("role=status aria-live=polite")

    def _columns(self) -> None:
        with ui.element("div").classes("row").style("width: 100%"):
            text("Columns:", "quiet")
            options = [_NATIVE, _GUESSED, *shipped_column_maps()]
            self._map = ui.select(options, value=_NATIVE, on_change=self._map_chosen)
            named(self._map.props("dense outlined options-dense").classes("flat"), "column map")
            self._message = text("", "quiet")
        self._table = ColumnsTable(self._check_now)

    @property
    def is_open(self) -> bool:
        """Whether keys belong to the dialog."""
        return bool(self._dialog.value)

    def show(self, choice: InputSelection) -> None:
        """Opens with what is chosen now."""
        self._choice = choice
        self._model.value = choice.model
        self._paths.value = "\n".join(choice.runs)
        self._horizon.value = choice.horizon
        if isinstance(choice.columns, str) and choice.columns not in self._map.options:
            self._map.set_options([*self._map.options, choice.columns])
        if isinstance(choice.columns, str):
            self._map.value = choice.columns
        self._dialog.open()
        self._refresh()

    def _rejected(self) -> None:
        """The browser itself did not send a file."""
        most = f"{limit('upload_bytes') / 1e6:.0f} MB"
        self._report(
            f"Not taken: wanted recordings ({' '.join(RECORDINGS)}) of at most {most}, {limit('uploads')} at most"
        )

    def _dropped(self) -> None:
        """Files were dropped on the page while the dialog was closed: it opens, and takes them once it is drawn."""
        if not self.is_open:
            self.show(self._choice)

    async def _uploaded(self, event: events.UploadEventArguments) -> None:
        """Keeps the file in the folder of sessions: a session that goes on later needs its recordings."""
        ending = Path(event.file.name).suffix.lower()
        there = len(list(self._uploads.glob("*"))) if self._uploads.is_dir() else 0
        if there >= limit("uploads") or ending not in RECORDINGS:
            self._report(
                f"{event.file.name}: not taken; wanted a recording ({' '.join(RECORDINGS)}), and at most "
                f"{limit('uploads')} files in {self._uploads}"
            )
            return
        path: Path | None = None
        try:
            path = self._place(there + 1, f"{_plain(event.file.name)}{ending}")
            await event.file.save(path)
        except OSError as error:
            if path is not None:
                with suppress(OSError):  # part of it
                    path.unlink()
            why = why_not_written(error)
            self._report(f"{event.file.name}: cannot be kept in {self._uploads} ({why}), or choose another --out")
            return
        self._upload_store = self._upload_store.with_folder(self._uploads)
        self._paths.value = "\n".join([*str(self._paths.value or "").splitlines(), str(path)])
        self._retained.append(f"Uploaded: {event.file.name}, {path.stat().st_size / 1e6:.2g} MB, to {path}")
        self._taken.set_content("<br>".join(map(escaped, self._retained[-_REPORTED:])))
        self._refresh()

    def _place(self, number: int, name: str) -> Path:
        """A new empty file of the folder: files that come together, here or in another tab, never share one."""
        self._uploads.mkdir(mode=0o700, parents=True, exist_ok=True)
        while True:
            path = self._uploads / f"{number:03d}_{name}"
            try:
                path.touch(exist_ok=False)
            except FileExistsError:
                number += 1
                continue
            return path

    def _files_named(self) -> list[str]:
        """The paths, patterns replaced by what they match; none where one may not be opened, which is said."""
        try:
            return self._upload_store.recordings(str(self._paths.value or "").splitlines())
        except SafedpaError as error:
            self._report(str(error))
            return []

    # columns

    def _loaded_model(self) -> PhysicsModel | None:
        try:
            name = str(self._model.value or "")
            return load_model(self._upload_store.model(name, shipped_models())) if name else None
        except SafedpaError as error:
            self._report(str(error))
            return None

    def _refresh(self) -> None:
        """Reads the first file's columns again."""
        model, paths = self._loaded_model(), self._files_named()
        if model is None or not paths:
            return
        try:
            self._raw = raw_rows(paths[0])
        except SafedpaError as error:
            self._report(str(error))
            return
        native = set(native_map(model.system).sources) <= set(self._raw.names)
        if self._raw.names and not native and self._map.value == _NATIVE:
            self._map.value = self._fitting(model) or _GUESSED  # calls _map_chosen
            return
        self._map_chosen()

    def _fitting(self, model: PhysicsModel) -> str:
        """A shipped map whose columns the file has; empty where there is none."""
        for name in shipped_column_maps():
            columns = load_column_map(name)
            if columns.robot == model.system.name and set(columns.sources) <= set(self._raw.names):
                return name
        return ""

    def _map_chosen(self) -> None:
        model = self._loaded_model()
        if model is None:
            return
        self._message.set_content(escaped("" if self._raw.names else "a recording of the bus needs no column map"))
        self._table.show(self._lines(model), self._raw)
        self._check_now()

    def _lines(self, model: PhysicsModel) -> list[QuantityForm]:
        if not self._raw.names:
            return []
        if self._map.value == _GUESSED:
            return guess_columns(model.system, self._raw.names)
        alongside = self._alongside()
        return lines_of(model.system, native_map(model.system) if alongside is None else alongside)

    def _alongside(self) -> ColumnMap | None:
        if self._map.value in (_NATIVE, _GUESSED):
            return None
        try:
            return load_column_map(str(self._map.value))
        except SafedpaError as error:
            self._report(str(error))
            return None

    def _made(self, model: PhysicsModel) -> EditedColumnMap | None:
        """The map as the table stands; None for a recording of the bus. Raises ColumnMapError."""
        if not self._raw.names:
            return None
        alongside = str(self._map.value) if self._alongside() is not None else ""
        made = EditedColumnMap(map_text(model.system, self._table.lines), alongside)
        made.columns  # noqa: B018  raises where the table describes none
        return made

    def _check_now(self) -> None:
        """Reads the first recording as the diagnosis would."""
        model, paths = self._loaded_model(), self._files_named()
        if model is None or not paths:
            return
        try:
            made = self._made(model)
        except SafedpaError as error:
            self._report(str(error))
            return
        columns = None if made is None else made.columns
        self._show_check(Path(paths[0]).name, len(paths), check_recording(paths[0], model.system, columns), model)

    def _report(self, problem: str) -> None:
        self._check.clear()
        with self._check:
            text(problem, "problem", "div")

    def _show_check(self, name: str, files: int, found: RecordingCheck, model: PhysicsModel) -> None:
        if found.problem:
            self._report(found.problem)
            return
        units = {variable.name: variable.unit for variable in (*model.system.state, *model.system.action)} | {"t": "s"}
        more = f" (first of {files} files)" if files > 1 else ""
        self._check.clear()
        with self._check:
            text(f"{name}{more}: {found.sentence}", "fine", "div")
            for message in found.findings:
                text(f"• {message}", "quiet", "div")
            ui.html(_table([f"{n} [{units[n]}]" for n in found.names], found.rows), sanitize=False).classes("preview")

    # leaving

    async def _open(self) -> None:
        model, paths = self._loaded_model(), self._files_named()
        if model is None or not paths:
            if not str(self._paths.value or "").strip():
                self._report("Choose a model and at least one recording.")
            elif not self._model.value:
                self._report("Choose a model.")
            return  # else it was said what cannot be opened
        try:
            columns = self._made(model)
        except SafedpaError as error:
            self._report(str(error))
            return
        choice = replace(
            self._choice, model=str(self._model.value), columns=columns, horizon=float(self._horizon.value)
        )
        self._dialog.close()
        await self._on_open(choice.with_runs(paths))

    def _save_map(self) -> None:
        model = self._loaded_model()
        if model is None or not self._table.lines:
            return
        path = self._out / "columns.toml"
        try:
            self._made(model)
            with atomic_path(path) as temporary:
                temporary.write_text(map_text(model.system, self._table.lines), encoding="utf-8")
        except SafedpaError as error:
            self._report(str(error))
            return
        ui.notify(f"Written: {path}", type="positive")


def _plain(name: str) -> str:
    """A name that a browser gave, as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name).stem)[:60]


def _table(names: list[str], rows: Any) -> str:
    head = "".join(f"<th>{escaped(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{value:.4g}</td>" for value in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


class ColumnsTable:
    """Source, unit, scale, offset and sign of every quantity; tells when one of them was changed."""

    def __init__(self, on_change: Callable[[], None]) -> None:
        self._on_change = on_change
        self.lines: list[QuantityForm] = []
        self._raw = RawRows((), ())
        self._grid = ui.element("div").classes("map-grid")

    def show(self, lines: list[QuantityForm], raw: RawRows) -> None:
        """Draws the form again."""
        self.lines, self._raw = list(lines), raw
        self._grid.clear()
        if not lines:
            return
        with self._grid:
            for title in ("quantity", "column of the file", "its unit", "times", "plus [SI]", "flip", "first values"):
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
        shown = {option: readable(option, limit("name_letters")) for option in options}  # a bag's topics among them
        box = ui.select(shown, value=known, on_change=lambda e: self._changed(index, field, str(e.value or "")))
        named(box.props("dense outlined options-dense").classes("flat"), title)

    def _number(self, index: int, field: str, value: float, title: str) -> None:
        box = ui.number(value=value, on_change=lambda e: self._changed(index, field, e.value))
        named(box.props("dense outlined debounce=400").classes("flat"), title)

    def _changed(self, index: int, field: str, value: Any) -> None:
        if value is None:
            return
        change: dict[str, Any] = {field: float(value) if field in ("scale", "offset") else value}
        if field == "source":
            change["retained"] = None
        self.lines[index] = replace(self.lines[index], **change)
        if field == "source":
            self.show(self.lines, self._raw)
        self._on_change()

    def _first_values(self, source: str) -> str:
        if source not in self._raw.names:
            return ""
        at = self._raw.names.index(source)
        return ", ".join(row[at][:9] for row in self._raw.rows[:3] if at < len(row))
