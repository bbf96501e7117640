"""The errors of h along a drive, as the filter's own watch over its margin sees them: what margins are calibrated on.

One walk for all: recordings and simulated drives go through the same memory of a robot that the deployed filter keeps,
so that whatever a barrier, a latent or an actuator's memory does to a prediction is in the calibration as in the watch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import LATENT, LatentMessage, Stale, StateMessage
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.safety.filtered_robot import Decided, FilteredRobot
from safedpa.safety.held_model import HeldModel, uncalibrated
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status, resting_verdict
from safedpa.safety.watched_margin import Seen

__all__ = ["DrivenTick", "drive_heights"]

Values = NDArray[np.float64]


class DrivenTick(NamedTuple):
    """A state, and the latent that the filter had for it."""

    state: StateMessage
    latent: LatentMessage | None


def drive_heights(model: PhysicsModel, settings: FilterSettings, ticks: Sequence[DrivenTick]) -> dict[str, Values]:
    """By kind of barrier (steps, 4): the least h, predicted by the barriers of then and measured; see ``Seen``.

    ``ticks`` of one start of one robot, in order. Steps whose action was not the filter's, whose latent is not known,
    or whose state makes no scene are left out. ``Ceiling.errors`` makes errors of them.
    """
    own = fingerprint(model)
    held = HeldModel(model, own, uncalibrated(settings, own))
    memory = FilteredRobot.begun(held, settings, period=ticks[0].state.period if ticks else None)
    memory.margin.learns = False
    found: dict[str, list[Seen]] = {}
    for index, tick in enumerate(ticks):
        memory.take_up(tick.state)
        for kind, seen in memory.margin.seen.items():
            if np.isfinite(seen).all():
                found.setdefault(kind, []).append(seen)
        following = ticks[index + 1].state if index + 1 < len(ticks) else None
        _go_on(memory, tick, following)
    return {kind: np.array(rows) for kind, rows in found.items()}


def _go_on(memory: FilteredRobot, tick: DrivenTick, following: StateMessage | None) -> None:
    """What the filter would expect of the next state under the action that was taken."""
    state = tick.state
    given = tick.latent if tick.latent is not None else Stale(LATENT, -1)
    latent, problems = memory.usable_latent(state, {LATENT: given})
    obeyed = following is not None and following.tick == state.tick + 1 and following.applied_by == "filter"
    if problems or isinstance(memory.barriers, str) or not obeyed or following is None:
        memory.margin.expect(None)
        return
    verdict = replace(resting_verdict(np.array(following.applied), "recorded"), status=Status.passed)
    memory.decision = Decided(state, latent, verdict)
    memory.foresee(state, verdict, latent)
