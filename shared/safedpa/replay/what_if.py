"""Computes what another filter would have decided on the recorded states (open loop), one verdict for each.

States and nominal actions stay as recorded; with another model the latents are estimated again from the states. The
robot executed the action of the recorded filter. Where the other filter decides differently, it sees in the next tick
that its action was not applied, as with a robot that is braked by its watchdog, and does not use that period for its
margin.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest
from math import inf
from pathlib import Path
from typing import final

from safedpa.bus import (
    ACTION,
    LATENT,
    VERDICT,
    ActionMessage,
    LatentMessage,
    Message,
    Outputs,
    SetupMessage,
    StateMessage,
    VerdictMessage,
)
from safedpa.dynamics import PhysicsModel, fingerprint
from safedpa.dynamics.model_offer import model_setup
from safedpa.errors import InputError, RunError
from safedpa.replay.driver import Driver, InputOverride
from safedpa.replay.setups import node_of
from safedpa.replay.tape import RobotTape
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import MarginCalibration, margin_text
from safedpa.safety.settings import parse_settings, write_settings

_SAME = 1e-6
"""Actions that differ by less are the same."""


@dataclass(frozen=True)
class WhatIfChange:
    """The changes of the filter."""

    model: PhysicsModel | None = None
    eta: float | None = None
    margin: float | MarginCalibration | None = None
    filtered: bool = False
    """Whether a disabled filter is enabled."""

    @property
    def is_empty(self) -> bool:
        """Whether nothing changes."""
        return self.model is None and self.eta is None and self.margin is None and not self.filtered

    def applied(self, setup: SetupMessage) -> SetupMessage:
        """Returns the changed setup of a service; raises InputError for values that no filter accepts."""
        changed = setup if self.model is None else model_setup(setup, self.model)
        if setup.service != "safety_filter":
            return changed
        settings = parse_settings(setup.settings)
        settings = replace(settings, enabled=settings.enabled or self.filtered)
        if self.eta is not None:
            settings = replace(settings, eta=self.eta)
        if isinstance(self.margin, MarginCalibration):
            settings, changed = replace(settings, margin="conformal"), replace(changed, margin=margin_text(self.margin))
        elif self.margin is not None:
            # a number needs no margin file, and the recorded file belongs to the recorded model
            settings, changed = replace(settings, margin=self.margin), replace(changed, margin="")
        elif self.model is not None and changed.fingerprint != setup.fingerprint:
            shipped = margin_for(self.model)
            changed = replace(changed, margin="" if shipped is None else margin_text(shipped))
        return replace(changed, settings=write_settings(settings))


@dataclass(frozen=True, slots=True)
class DecisionPair:
    """The recorded verdict of a tick (``then``) and that of the other filter (``now``)."""

    state: StateMessage
    then: VerdictMessage
    now: VerdictMessage

    @property
    def differs(self) -> bool:
        """Whether status or action differ."""
        return self.then.status != self.now.status or self.distance > _SAME

    @property
    def knows_h(self) -> bool:
        """Whether both could compute h; without a latent the verdict has 0 instead."""
        return all((side.h_now, side.h_next) != (0.0, 0.0) for side in (self.then, self.now))

    @property
    def distance(self) -> float:
        """Largest difference between the actions, over their entries."""
        return _max_difference(self.then.action, self.now.action)


@dataclass(frozen=True)
class WhatIfSummary:
    """Statistics of all ticks."""

    ticks: int
    differing: int
    status_then: dict[str, int]
    status_now: dict[str, int]
    smallest_h_now: float
    """Smallest barrier value h at the recorded states."""
    smallest_h_then: float
    """Smallest h that the recorded filter predicted for a next state."""
    smallest_h_other: float
    """Smallest h that the other filter predicted."""
    largest_distance: float
    largest_distance_at: float
    """Time of the largest distance by the robot's clock, s."""


def what_if(
    tape: RobotTape, change: WhatIfChange, window: tuple[float, float] = (-inf, inf), folders: tuple[Path, ...] = ()
) -> list[DecisionPair]:
    """Decides again on states in ``window`` [s]; raises InputError if the change does not fit the recording."""
    if not tape.computed["safety_filter"]:
        raise RunError(
            f"{tape.files[0]}: contains no verdict of robot '{tape.robot}'; there is nothing to decide again"
        )
    _check(tape, change)
    estimates = _estimates(tape, change, folders) if change.model is not None else {}
    driver = Driver(
        tape,
        "safety_filter",
        lambda setup: node_of(change.applied(setup), folders),
        _Hypothetical(estimates),
        follow_models=change.model is None,
    )
    return [decision for decision in _decisions(driver) if window[0] <= decision.state.robot_time <= window[1]]


def _decisions(driver: Driver) -> Iterator[DecisionPair]:
    for step in driver.run():
        now = step.outputs.get(VERDICT)
        if isinstance(step.recorded, VerdictMessage) and isinstance(now, VerdictMessage):
            yield DecisionPair(step.state, step.recorded, now)


def summary_of(decisions: list[DecisionPair]) -> WhatIfSummary:
    """Summarizes decisions; raises InputError if there are none."""
    if not decisions:
        raise InputError("--from, --to: got a stretch without any verdict, wanted one within the recording")
    known = [decision for decision in decisions if decision.knows_h] or decisions
    most_different = max(decisions, key=lambda decision: decision.distance)
    return WhatIfSummary(
        ticks=len(decisions),
        differing=sum(decision.differs for decision in decisions),
        status_then=dict(Counter(decision.then.status for decision in decisions)),
        status_now=dict(Counter(decision.now.status for decision in decisions)),
        smallest_h_now=min(decision.now.h_now for decision in known),
        smallest_h_then=min(decision.then.h_next for decision in known),
        smallest_h_other=min(decision.now.h_next for decision in known),
        largest_distance=most_different.distance,
        largest_distance_at=most_different.state.robot_time,
    )


def _check(tape: RobotTape, change: WhatIfChange) -> None:
    if change.model is None:
        return
    state, system = next(iter(tape.states.values())), change.model.system
    if (len(state.values), len(state.applied)) != (len(system.state), len(system.action)):
        raise InputError(
            f"--model: a {system.name} of {len(system.state)} states and {len(system.action)} actions; the recorded "
            f"robot has {len(state.values)} and {len(state.applied)}"
        )
    if isinstance(change.margin, MarginCalibration) and change.margin.fingerprint != fingerprint(change.model):
        raise InputError(
            f"--margin: calibrated for model {change.margin.fingerprint}, --model is {fingerprint(change.model)}"
        )


def _estimates(
    tape: RobotTape, change: WhatIfChange, folders: tuple[Path, ...]
) -> dict[tuple[int, int, float], LatentMessage]:
    """Latent of the other model for each recorded one, by epoch, tick and publish time of the recorded one."""
    found: dict[tuple[int, int, float], LatentMessage] = {}
    if not tape.computed["adaptation"] or not tape.setups.get("adaptation"):
        return found
    driver = Driver(tape, "adaptation", lambda setup: node_of(change.applied(setup), folders), follow_models=False)
    for step in driver.run():
        latent, recorded = step.outputs.get(LATENT), step.recorded
        if recorded is not None and isinstance(latent, LatentMessage):
            found[recorded.epoch, recorded.tick, recorded.publish_time] = latent
    return found


@final
class _Hypothetical(InputOverride):
    """Shows the other filter its own latents, and marks states in which its last action was not applied."""

    def __init__(self, estimates: dict[tuple[int, int, float], LatentMessage]) -> None:
        self._estimates = estimates
        self._predicted_actions: dict[tuple[int, int], tuple[float, ...]] = {}

    def state(self, state: StateMessage) -> StateMessage:
        predicted = self._predicted_actions.get((state.epoch, state.tick - 1))
        obeyed = predicted is None or _max_difference(predicted, state.applied) <= _SAME
        return state if obeyed else replace(state, applied_by="recorded")

    def message(self, recorded: Message) -> Message:
        name = (recorded.epoch, recorded.tick, recorded.publish_time)
        return self._estimates.get(name, recorded) if isinstance(recorded, LatentMessage) else recorded

    def done(self, state: StateMessage, outputs: Outputs) -> None:
        action = outputs.get(ACTION)
        if isinstance(action, ActionMessage):
            self._predicted_actions = {(state.epoch, state.tick): action.values}


def _max_difference(one: Sequence[float], other: Sequence[float]) -> float:
    """Largest difference of an entry; missing entries count as 0, because foreign recordings may have any length."""
    return max((abs(a - b) for a, b in zip_longest(one, other, fillvalue=0.0)), default=0.0)
