"""The dialog that chooses a model, recordings, and how their columns are read."""

from __future__ import annotations

import re
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from nicegui import events, ui

from safedpa.dynamics import PhysicsModel, load_model, shipped_models
from safedpa.errors import SafedpaError
from safedpa.limits import limit
from safedpa.records import ColumnMap, load_column_map
from safedpa.records.column_map import native_map
from safedpa.records.column_map_file import shipped_column_maps
from safedpa_services.web.shelf import RECORDINGS, Shelf
from safedpa_services.workbench.column_form import Line, guessed, lines_of, map_text
from safedpa_services.workbench.columns_table import ColumnsTable
from safedpa_services.workbench.elements import action, escaped, named, on_change_of, text
from safedpa_services.workbench.file_preview import Checked, RawRows, checked, raw_rows
from safedpa_services.workbench.recordings import Choice, Made

__all__ = ["OpenDialog"]

_GUESSED = "guessed from the names"
_NATIVE = "native names"
_NAME_UPLOAD = """(node) => {
  const input = node.el?.querySelector?.('input[type=file]');
  if (!input) return;
  input.setAttribute('aria-label', 'upload recordings');
  input.setAttribute('tabindex', '0');
  const sign = input.closest('a');
  if (sign) { sign.removeAttribute('role'); sign.removeAttribute('tabindex'); sign.removeAttribute('href'); }
}"""
"""The framework draws a link around the control; the control itself is what the keyboard reaches."""


class OpenDialog:
    """Model, files, columns; a preview in SI units and what the quality checks say, before anything is opened."""

    def __init__(self, on_open: Callable[[Choice], Awaitable[None]], out: Path, shelf: Shelf) -> None:
        self._on_open, self._out, self._shelf = on_open, out, shelf
        self._choice = Choice()
        self._raw = RawRows((), ())
        self._uploads = out / "uploads"
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
            self._paths = ui.textarea("Recordings on this machine, one path or pattern a line (.csv .parquet .mcap)")
            self._paths.props("dense outlined autogrow").style("flex: 1").on("blur", self._refresh)
            upload = ui.upload(label="or drag them here", multiple=True, auto_upload=True, on_upload=self._uploaded)
            upload.props(f"max-file-size={limit('upload_bytes')} max-files={limit('uploads')}")
            upload.props('flat bordered accept=".csv,.parquet,.mcap" aria-label="upload recordings"')
            upload.style("width: 250px; max-height: 110px")
            on_change_of(upload, _NAME_UPLOAD)

    def _columns(self) -> None:
        with ui.element("div").classes("row").style("width: 100%"):
            text("Columns:", "quiet")
            options = [_NATIVE, _GUESSED, *shipped_column_maps()]
            self._map = ui.select(options, value=_NATIVE, on_change=self._map_chosen)
            named(self._map.props("dense outlined options-dense").classes("flat"), "column map")
            self._said = text("", "quiet")
        self._table = ColumnsTable(self._check_now)

    @property
    def is_open(self) -> bool:
        """Whether keys belong to the dialog."""
        return bool(self._dialog.value)

    def show(self, choice: Choice) -> None:
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

    async def _uploaded(self, event: events.UploadEventArguments) -> None:
        """Keeps the file in the folder of sessions: a session that goes on later needs its recordings."""
        ending = Path(event.file.name).suffix.lower()
        there = len(list(self._uploads.glob("*"))) if self._uploads.is_dir() else 0
        if there >= limit("uploads") or ending not in RECORDINGS:
            self._say(
                f"{event.file.name}: not taken; wanted a recording ({' '.join(RECORDINGS)}), and at most "
                f"{limit('uploads')} files in {self._uploads}"
            )
            return
        path = self._uploads / f"{there + 1:03d}_{_plain(event.file.name)}{ending}"
        try:
            self._uploads.mkdir(mode=0o700, parents=True, exist_ok=True)
            await event.file.save(path)
        except OSError as error:
            self._say(
                f"{event.file.name}: cannot be kept in {self._uploads} ({error.strerror}); make room or choose --out"
            )
            return
        self._shelf = self._shelf.with_folder(self._uploads)
        self._paths.value = "\n".join([*str(self._paths.value or "").splitlines(), str(path)])
        self._refresh()

    def _files_named(self) -> list[str]:
        """The paths, patterns replaced by what they match; none where one may not be opened, which is said."""
        try:
            return self._shelf.recordings(str(self._paths.value or "").splitlines())
        except SafedpaError as error:
            self._say(str(error))
            return []

    # columns

    def _loaded_model(self) -> PhysicsModel | None:
        try:
            name = str(self._model.value or "")
            return load_model(self._shelf.model(name, shipped_models())) if name else None
        except SafedpaError as error:
            self._say(str(error))
            return None

    def _refresh(self) -> None:
        """Reads the first file's columns anew."""
        model, paths = self._loaded_model(), self._files_named()
        if model is None or not paths:
            return
        try:
            self._raw = raw_rows(paths[0])
        except SafedpaError as error:
            self._say(str(error))
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
        self._said.set_content(escaped("" if self._raw.names else "a recording of the bus needs no column map"))
        self._table.show(self._lines(model), self._raw)
        self._check_now()

    def _lines(self, model: PhysicsModel) -> list[Line]:
        if not self._raw.names:
            return []
        if self._map.value == _GUESSED:
            return guessed(model.system, self._raw.names)
        beside = self._beside()
        return lines_of(model.system, native_map(model.system) if beside is None else beside)

    def _beside(self) -> ColumnMap | None:
        if self._map.value in (_NATIVE, _GUESSED):
            return None
        try:
            return load_column_map(str(self._map.value))
        except SafedpaError as error:
            self._say(str(error))
            return None

    def _made(self, model: PhysicsModel) -> Made | None:
        """The map as the table stands; None for a recording of the bus. Raises ColumnMapError."""
        if not self._raw.names:
            return None
        beside = str(self._map.value) if self._beside() is not None else ""
        made = Made(map_text(model.system, self._table.lines), beside)
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
            self._say(str(error))
            return
        columns = None if made is None else made.columns
        self._show_check(Path(paths[0]).name, len(paths), checked(paths[0], model.system, columns), model)

    def _say(self, problem: str) -> None:
        self._check.clear()
        with self._check:
            text(problem, "problem", "div")

    def _show_check(self, name: str, files: int, found: Checked, model: PhysicsModel) -> None:
        if found.problem:
            self._say(found.problem)
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
                self._say("Choose a model and at least one recording.")
            elif not self._model.value:
                self._say("Choose a model.")
            return  # else it was said what cannot be opened
        try:
            columns = self._made(model)
        except SafedpaError as error:
            self._say(str(error))
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
            self._out.mkdir(parents=True, exist_ok=True)
            path.write_text(map_text(model.system, self._table.lines), encoding="utf-8")
        except (SafedpaError, OSError) as error:
            self._say(str(error))
            return
        ui.notify(f"Written: {path}", type="positive")


def _plain(name: str) -> str:
    """A name that a browser gave, as part of a file's name."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", Path(name).stem)[:60]


def _table(names: list[str], rows: Any) -> str:
    head = "".join(f"<th>{escaped(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(f"<td>{value:.4g}</td>" for value in row) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"
