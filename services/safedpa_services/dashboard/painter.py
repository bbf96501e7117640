"""Draws frames with Rerun. With ``blueprint`` the only file that knows it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr

from safedpa.errors import InputError
from safedpa_services.dashboard.blueprint import TIME_LINE, blueprint_of
from safedpa_services.dashboard.fleet_view import Scene
from safedpa_services.dashboard.look import Look
from safedpa_services.dashboard.meaning import meaning
from safedpa_services.dashboard.now_page import waiting_page
from safedpa_services.dashboard.shapes import (
    Bands,
    Curves,
    Discs,
    Entry,
    Frame,
    Lines,
    Note,
    Page,
    Rings,
    Shape,
    States,
    StateSet,
)

__all__ = ["Painter"]

APPLICATION = "safedpa"
SERVER_MEMORY = "256MB"
_FLUSH_SECONDS = 1.0
_BATCH_SECONDS = 0.4
"""Rows of one path wait for so long to be sent together: half the size of the file for a barely later picture."""


class Painter:
    """A recording that goes to a file, to viewers, or to both.

    Raises InputError when the file cannot be written or the port is taken.
    """

    def __init__(
        self,
        look: Look,
        fleet: str,
        *,
        save: Path | None,
        bind: str,
        grpc_port: int | None,
        memory: str = SERVER_MEMORY,
    ) -> None:
        self._look = look
        batches = rr.ChunkBatcherConfig.DEFAULT()
        batches.flush_tick = _BATCH_SECONDS
        self._stream = rr.RecordingStream(APPLICATION, batcher_config=batches)
        self.server_uri = ""
        sinks: list[Any] = []
        try:
            if grpc_port is not None:
                server = rr.GrpcServerSink(bind, grpc_port, server_memory_limit=memory, newest_first=True)
                self.server_uri = str(server.uri)
                sinks.append(server)
            if save is not None:
                sinks.append(rr.FileSink(save, write_footer=False))  # a footer is lost anyway when the power fails
            self._stream.set_sinks(*sinks)
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(f"recording {save}, port {grpc_port}: {error}; choose another --save or port") from error
        self._log(Entry(("waiting",), waiting_page(fleet, {}), static=True))
        self._log(Entry(("meaning",), Page(meaning(look)), static=True))
        self.arrange({})

    def arrange(self, fields: dict[str, Scene]) -> None:
        """Shows one tab for each robot; replaces what the viewer's user arranged."""
        for name in fields:
            # true coordinates are logged; the viewer counts y downwards, so the world is mirrored where it is shown
            for plane in ("world", "phase"):
                self._stream.log(["robots", name, plane], rr.Transform3D(scale=[1.0, -1.0, 1.0]), static=True)
        self._stream.send_blueprint(blueprint_of(fields, self._look))

    def draw(self, frames: list[Frame]) -> None:
        """Hands the frames to the viewers and the file; does not wait for either."""
        for frame in frames:
            self._stream.set_time(TIME_LINE, duration=frame.at)
            for entry in frame.entries:
                self._log(entry, frame.at)

    def close(self) -> None:
        """Writes what is still on its way, for a second at most."""
        self._stream.flush(timeout_sec=_FLUSH_SECONDS)
        self._stream.disconnect()

    def _log(self, entry: Entry, at: float = 0.0) -> None:
        self._stream.log(list(entry.path), _archetype(entry.shape, at, static=entry.static), static=entry.static)


def _archetype(shape: Shape, at: float, *, static: bool) -> Any:  # noqa: PLR0911 - one line for each kind of shape
    match shape:
        case Discs(centres, radii, colour):
            return rr.Points2D(_points(centres), radii=radii, colors=_colours((colour,)))
        case Rings(centres, radii, colour, width):
            sizes = np.repeat(np.array(radii, dtype=np.float32).reshape(-1, 1), 2, axis=1)
            return rr.Ellipses2D(
                centers=_points(centres), half_sizes=sizes, colors=_colours((colour,)), line_radii=[width]
            )
        case Lines(strips, colours, width):
            return rr.LineStrips2D([_points(strip) for strip in strips], colors=_colours(colours), radii=[width])
        case Curves(values, names, colours, widths):
            if static:
                return rr.SeriesLines(names=list(names), colors=_colours(colours), widths=list(widths))
            return rr.Scalars(list(values))
        case Bands(value, deviation, name, unit, colour):
            if static:
                units = [unit] if unit not in ("", "1") else None
                colours = _colours((colour,))
                return rr.Measurements.from_fields(names=[name], units=units, colors=colours, widths=[2.0])
            return rr.Measurements([value], variances=[deviation**2])
        case States(state):
            return rr.StateChange(state=state)
        case StateSet(colours):
            return rr.StateConfiguration(values=list(colours), colors=_colours(tuple(colours.values())))
        case Note(text, colour, level):
            return rr.TextLog(f"{at:.1f} s  {text}", level=level, color=colour)
        case Page(text):
            return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)


def _colours(colours: tuple[int, ...]) -> Any:
    return np.array(colours, dtype=np.uint32)  # four plain numbers would be read as one colour


def _points(points: tuple[tuple[float, float], ...]) -> Any:
    return np.array(points, dtype=np.float32).reshape(-1, 2)
