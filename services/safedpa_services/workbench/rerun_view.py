"""What the page shows as a Rerun recording that begins at the chosen start, and the viewer for it, served from here."""

from __future__ import annotations

import asyncio
import secrets
import shutil
import tempfile
import urllib.parse
from pathlib import Path
from typing import Any

import numpy as np
from fastapi import Response
from fastapi.responses import FileResponse
from nicegui import app

from safedpa.arrays import FloatArray
from safedpa.comparison.rollout import rollout
from safedpa.comparison.where import PLACE
from safedpa.comparison.windows import Windows
from safedpa.errors import RecordingError, SafedpaError
from safedpa_services.web.viewer import VIEWER_POLICY, Viewer
from safedpa_services.workbench.session import Session

__all__ = ["RerunViewerServer", "write_view"]

_SECONDS = 20.0
"""That are played from the chosen start on."""
_TIME_LINE = "t"
_COLOURS = ((216, 94, 0), (138, 148, 160), (0, 114, 178))
"""Of the given version, those between, the present one; of Okabe and Ito."""
_MEASURED = (200, 200, 200)


_ROOM_BYTES = 64 << 20
"""A view has some MB; the library that writes it does not say that the disk is full."""


def _require_room(path: Path) -> None:
    if shutil.disk_usage(path.parent).free < _ROOM_BYTES:
        raise RecordingError(f"{path.parent}: cannot be written (the disk is full: make room)")


def write_view(session: Session, path: Path) -> None:
    """Writes measured and predicted states of the chosen run, from the chosen start on, restarted each horizon.

    The time line is the run's own time; its first moment is the chosen start. Raises RecordingError when the file
    cannot be written.
    """
    import rerun as rr
    import rerun.blueprint as rrb

    windows = _from_start(session)
    _require_room(path)
    stream = rr.RecordingStream("safedpa workbench")
    try:
        stream.set_sinks(rr.FileSink(path))
    except (RuntimeError, ValueError, OSError) as error:
        raise RecordingError(f"{path}: cannot be written ({error}); choose another folder with --out") from error
    panels: list[Any] = [rrb.TimeSeriesView(origin=f"states/{v.name}", name=v.name) for v in windows.system.state]
    if set(PLACE) <= set(windows.system.state_names):
        panels.insert(0, rrb.Spatial2DView(origin="plane", name="plane"))
    time = rrb.TimePanel(timeline=_TIME_LINE, play_state="paused")
    around = rrb.SelectionPanel(state="collapsed"), rrb.BlueprintPanel(state="collapsed")
    stream.send_blueprint(rrb.Blueprint(rrb.Grid(*panels), time, *around))
    rows = [np.arange(start, end + 1) for start, end in zip(windows.start, windows.end, strict=True)]
    at = np.concatenate(rows)
    _log(stream, "measured", windows, windows.states[at], at, _MEASURED)
    for number, version in enumerate(session.versions):
        predicted = rollout(version.model, windows)
        states = np.concatenate([predicted[: len(part), index] for index, part in enumerate(rows)])
        colour = _COLOURS[2] if number == session.number else _COLOURS[min(number, 1)]
        _log(stream, version.label.replace("+", "with").replace(" ", "_"), windows, states, at, colour)
    stream.flush(timeout_sec=10.0)
    stream.disconnect()  # closes the file


def _from_start(session: Session) -> Windows:
    """Windows of one horizon each, one after the other, from the chosen start on; no later than the stretch's end."""
    windows = session.comparison.windows
    first = session.start
    begin, run = windows.begin[first], windows.run[first]
    retained = [first]
    for index in range(first + 1, len(windows)):
        same = windows.begin[index] == begin and windows.run[index] == run
        late = windows.time[windows.start[index]] - windows.time[windows.start[first]] > _SECONDS
        if same and not late and windows.start[index] >= windows.end[retained[-1]]:
            retained.append(index)
    return windows.select(np.array(retained, dtype=np.int64))


def _log(stream: Any, name: str, windows: Windows, states: FloatArray, at: Any, colour: tuple[int, int, int]) -> None:
    import rerun as rr

    time = rr.TimeColumn(_TIME_LINE, duration=windows.time[at])
    for index, state in enumerate(windows.system.state):
        path = f"states/{state.name}/{name}"
        stream.log(path, rr.SeriesLines(colors=[colour], names=[name], widths=[2.0]), static=True)
        stream.send_columns(path, [time], rr.Scalars.columns(scalars=states[:, index]))
    if set(PLACE) <= set(windows.system.state_names):
        place = [windows.system.state_names.index(key) for key in PLACE]
        points = states[:, place] * np.array([1.0, -1.0])  # the viewer counts y downwards
        ends = np.cumsum([step + 1 for step in windows.steps.tolist()])[:-1]
        stream.log(f"plane/{name}", rr.LineStrips2D(np.split(points, ends), colors=[colour], radii=0.02), static=True)
        dots = rr.Points2D.columns(positions=points, colors=[colour] * len(points), radii=[0.05] * len(points))
        stream.send_columns(f"plane/{name}/now", [time], dots)


class RerunViewerServer:
    """Serves Rerun's own web viewer under this page's address, and the recordings that were written for it."""

    def __init__(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="safedpa-workbench-")
        self._viewer = Viewer()
        app.on_shutdown(self._folder.cleanup)
        app.get("/rerun/recordings/{name}", include_in_schema=False)(self._recording)
        app.get("/rerun/{name:path}", include_in_schema=False)(self._file)

    async def open(self, session: Session, origin: str) -> str:
        """Writes the recording; returns the address at which the viewer shows it."""
        name = f"{secrets.token_hex(8)}.rrd"
        await asyncio.to_thread(write_view, session, Path(self._folder.name) / name)
        recording = urllib.parse.quote(f"{origin}/rerun/recordings/{name}", safe="")
        return f"/rerun/?url={recording}"

    async def _recording(self, name: str) -> Response:
        path = Path(self._folder.name) / Path(name).name
        return FileResponse(path) if path.is_file() else Response(status_code=404)

    async def _file(self, name: str) -> Response:
        try:
            found = await asyncio.to_thread(self._viewer.file, name)
        except SafedpaError as error:
            return Response(str(error), status_code=503)
        if found is None:
            return Response(status_code=404)
        content, kind = found
        # said to be encoded already: to compress 40 MB would hold up every page for seconds
        headers = {"Content-Security-Policy": VIEWER_POLICY.format(more=""), "Content-Encoding": "identity"}
        return Response(content, media_type=kind, headers=headers)
