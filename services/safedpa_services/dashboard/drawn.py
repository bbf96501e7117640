"""A recording of the bus as a Rerun recording: drawn as the live dashboard would have drawn it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from safedpa.bus import FINDING, HEALTH, LATENT, MODEL, STATE, VERDICT, Received, decode, topic_of
from safedpa.errors import MessageError
from safedpa.records.mcap_messages import read_payloads
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.look import Look

__all__ = ["draw_recording"]

_TOPICS = (STATE, VERDICT, FINDING, MODEL, HEALTH, LATENT)
_BATCH_SECONDS = 0.25
"""Messages that are drawn together, by the clock of the recording."""


def draw_recording(files: Sequence[Path], look: Look, path: Path) -> None:
    """Writes all robots of the recordings to an .rrd file. Raises InputError when it cannot be written."""
    from safedpa_services.dashboard.painter import Painter

    view, fleet, known = FleetView(look), "recording", 0
    painter = Painter(look, fleet, save=path, bind="127.0.0.1", grpc_port=None)
    for items in _batches(files):
        frames = view.take(list(items), items[-1].at)
        if len(view.fields) != known:
            known = len(view.fields)
            painter.arrange(view.fields)
        painter.draw(frames)
    painter.close()


def _batches(files: Sequence[Path]) -> Iterator[list[Received]]:
    batch: list[Received] = []
    for item in _received(files):
        if batch and item.at - batch[0].at > _BATCH_SECONDS:
            yield batch
            batch = []
        batch.append(item)
    if batch:
        yield batch


def _received(files: Sequence[Path]) -> Iterator[Received]:
    """As from the bus, with the time of recording [s] in place of the time of arrival."""
    for path in files:
        for key, at, topic, payload in read_payloads(path, topics=_TOPICS):
            try:
                message = decode(topic.message, payload)
            except MessageError:
                continue
            yield Received(topic, topic_of(key)[1], message, payload, key, 1e-9 * at)
