"""The heartbeat of a service for one robot, or for none."""

from __future__ import annotations

import os
import time

from safedpa.bus.loop.slot import Counts, Slot
from safedpa.bus.wire.messages import HealthMessage
from safedpa.bus.wire.version import software_version

__all__ = ["NO_ROBOT", "heartbeat"]

NO_ROBOT = "-"
"""Stands for the robot in the health key of a service that serves none yet."""


def heartbeat(service: str, slot: Slot | None, strangers: Counts, model: str) -> HealthMessage:
    """What ``service`` tells of one robot: its own steps, stale inputs and refusals, and those of nobody it serves."""
    counts = strangers if slot is None else slot.counts
    refused = counts.refused if slot is None else counts.refused + strangers.refused
    return HealthMessage(
        epoch=slot.state.epoch if slot else 0,
        tick=slot.state.tick if slot else 0,
        robot_time=slot.state.robot_time if slot else 0.0,
        publish_time=time.time(),
        service=service,
        pid=os.getpid(),
        state="failing" if counts.failing else "running" if slot else "ready",
        detail=counts.detail,
        steps=counts.steps,
        stale=counts.stale,
        refused=refused,
        step_microseconds=counts.microseconds,
        model=model,
        software=software_version(),
    )
