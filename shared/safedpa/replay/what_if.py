"""What another filter would have decided on the recorded states: open loop, one verdict for each recorded one.

The states and nominal actions stay the recorded ones. With another model its latents are estimated again from the recorded
states. What the robot did was what the recorded filter said; where the other one says something else, it sees in the
next tick that the robot did not do that, as it would with a robot that is braked by its watchdog. So it learns nothing
about its margin from that period.
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
from safedpa.dynamics.model_setup import model_setup
from safedpa.errors import InputError, RunError
from safedpa.replay.driver import Driver, InputOverride
from safedpa.replay.setups import node_of
from safedpa.replay.tape import RobotTape
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import MarginCalibration, margin_text
from safedpa.safety.settings import parse_settings, write_settings

__all__ = ["DecisionPair", "WhatIfChange", "WhatIfSummary", "summary_of", "what_if"]

_SAME = 1e-6
"""Actions that differ by less are the same."""


@dataclass(frozen=True)
class WhatIfChange:
    """What is to be different."""

    model: PhysicsModel | None = None
    eta: float | None = None
    margin: float | MarginCalibration | None = None
    filtered: bool = False
    """Whether a filter that was switched off is on."""

    @property
    def is_none(self) -> bool:
        """Whether nothing is."""
        return self.model is None and self.eta is None and self.margin is None and not self.filtered

    def applied(self, setup: SetupMessage) -> SetupMessage:
        """A service's setup with what is different. Raises InputError for values that no filter can have."""
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
            # a number needs no file, and the recorded one is the recorded model's
            settings, changed = replace(settings, margin=self.margin), replace(changed, margin="")
        elif self.model is not None and changed.fingerprint != setup.fingerprint:
            shipped = margin_for(self.model)
            changed = replace(changed, margin="" if shipped is None else margin_text(shipped))
        return replace(changed, settings=write_settings(settings))


@dataclass(frozen=True, slots=True)
class DecisionPair:
    """One tick: what was decided, and what the other filter would have decided."""

    state: StateMessage
    then: VerdictMessage
    now: VerdictMessage

    @property
    def differs(self) -> bool:
        """Whether status or action are not the same."""
        return self.then.status != self.now.status or self.distance > _SAME

    @property
    def knows_h(self) -> bool:
        """Whether both could compute h: without a latent they cannot, and it stands as 0 in the verdict."""
        return all((side.h_now, side.h_next) != (0.0, 0.0) for side in (self.then, self.now))

    @property
    def distance(self) -> float:
        """Largest difference of an entry of the actions."""
        return _apart(self.then.action, self.now.action)


@dataclass(frozen=True)
class WhatIfSummary:
    """All ticks together."""

    ticks: int
    differing: int
    status_then: dict[str, int]
    status_now: dict[str, int]
    smallest_h_now: float
    """Least barrier value at the recorded states."""
    smallest_h_then: float
    """Least barrier value that was predicted for a next state, by the recorded filter."""
    smallest_h_other: float
    """The same, by the other one."""
    largest_distance: float
    largest_distance_at: float
    """s, robot time."""


def what_if(
    tape: RobotTape, change: WhatIfChange, window: tuple[float, float] = (-inf, inf), folders: tuple[Path, ...] = ()
) -> list[DecisionPair]:
    """The decisions with robot time in ``window`` [s]. Raises InputError when the change does not fit the recording."""
    if not tape.computed["safety_filter"]:
        raise RunError(f"{tape.files[0]}: holds no verdict of robot '{tape.robot}'; nothing to be decided again")
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
    """The figures of all decisions. Raises InputError when there are none."""
    if not decisions:
        raise InputError("--from, --to: got a stretch without any verdict, wanted one within the recording")
    known = [decision for decision in decisions if decision.knows_h] or decisions
    farthest = max(decisions, key=lambda decision: decision.distance)
    return WhatIfSummary(
        ticks=len(decisions),
        differing=sum(decision.differs for decision in decisions),
        status_then=dict(Counter(decision.then.status for decision in decisions)),
        status_now=dict(Counter(decision.now.status for decision in decisions)),
        smallest_h_now=min(decision.now.h_now for decision in known),
        smallest_h_then=min(decision.then.h_next for decision in known),
        smallest_h_other=min(decision.now.h_next for decision in known),
        largest_distance=farthest.distance,
        largest_distance_at=farthest.state.robot_time,
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
    """The other model's latent in place of each recorded one, by epoch, tick and publish time of that."""
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
    """Shows the other filter its own latents, and that the robot did not do what it had said."""

    def __init__(self, estimates: dict[tuple[int, int, float], LatentMessage]) -> None:
        self._estimates = estimates
        self._message: dict[tuple[int, int], tuple[float, ...]] = {}

    def state(self, state: StateMessage) -> StateMessage:
        notice = self._message.get((state.epoch, state.tick - 1))
        obeyed = notice is None or _apart(notice, state.applied) <= _SAME
        return state if obeyed else replace(state, applied_by="recorded")

    def message(self, recorded: Message) -> Message:
        name = (recorded.epoch, recorded.tick, recorded.publish_time)
        return self._estimates.get(name, recorded) if isinstance(recorded, LatentMessage) else recorded

    def done(self, state: StateMessage, outputs: Outputs) -> None:
        action = outputs.get(ACTION)
        if isinstance(action, ActionMessage):
            self._message = {(state.epoch, state.tick): action.values}


def _apart(one: Sequence[float], other: Sequence[float]) -> float:
    """Largest difference of an entry; what is not there counts as 0, since recordings of others may hold anything."""
    return max((abs(here - there) for here, there in zip_longest(one, other, fillvalue=0.0)), default=0.0)
