"""A live drive as a recording of everything that was said on its bus."""

from __future__ import annotations

from pathlib import Path

from safedpa.bus import ReceivedMessage
from safedpa.records.writers.mcap import McapRecorder
from safedpa_lab.experiments.live_drive import LiveDrive, drive_live

__all__ = ["record_drive"]

_READING = 5.0
"""s."""
_BEGIN = 1_700_000_000 * 10**9
"""ns since 1970 at which the recording's clock begins: the same drive gives the same times."""


def record_drive(case: str, seed: int, seconds: float, after: float, path: Path) -> LiveDrive:
    """Drives as ``drive_live`` does and writes every message; log times follow the robot's clock.

    A person who looks at it later reads the candidates for some seconds, so it takes these before it accepts.
    """
    with McapRecorder(path) as recorder:

        def write(item: ReceivedMessage) -> None:
            at = _BEGIN + round(1e9 * item.message.robot_time)
            recorder.write(item.key, item.payload, at, at)

        return drive_live(case, seed, seconds, after, hear=write, reading=_READING)
