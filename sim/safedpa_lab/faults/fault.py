"""What a fault is: set-up, fault, recovery, invariant."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from safedpa_lab.faults.episode import Episode
from safedpa_lab.faults.world import World

Work = Callable[[World], None]
Look = Callable[[World], str]
Meanwhile = Literal["undisturbed", "drives", "anything"]


def meanwhile_of(*names: str) -> Meanwhile:
    """What the loop must do while something happens to a process: of those that run alongside it, not even notice."""
    return "undisturbed" if names and names[0] in ("diagnosis", "recorder") else "anything"


def nothing(_world: World) -> None:
    """Nothing to be done."""


def nothing_to_see(_world: World) -> str:
    """Nothing is expected to be seen."""
    return ""


def no_more(_world: World, _episode: Episode) -> str:
    """No invariant beyond those of every fault."""
    return ""


@dataclass(frozen=True)
class Fault:
    """One row of the table. Every fault is compared with the same invariants, whatever else it names itself:

    no collision; no action applied that is not the filter's answer to the state of that very period, or that is older
    than two periods; and the loop drives again within ``recovers_within`` after the recovery.
    """

    name: str
    """Kind and target, such as ``kill safety_filter``."""
    sentence: str
    """What happens, and for how long."""
    strike: Work
    """The fault; called while the robot drives."""
    repair: Work = nothing
    """The recovery: what a supervisor, a network or a person would do."""
    seconds: float = 0.0
    """Between both."""
    look: Look = nothing_to_see
    """What must be seen at the height of the fault, just before the recovery: empty, or what was seen instead."""
    set_up: Work = nothing
    """Before the robot is awaited to drive."""
    clean_up: Work = nothing
    """After it was judged."""
    meanwhile: Meanwhile = "anything"
    """What the loop must do during the fault: not notice it, drive with some periods braked, or only be safe."""
    check: Callable[[World, Episode], str] = no_more
    """A further invariant: empty, or how it was broken."""
    recovers_within: float = 10.0
    """s."""
    diagnosis: Literal["real", "ready"] = "real"
    """Which diagnosis must run alongside the loop."""
    small: bool = False
    """Whether the small version of the campaign holds it, too."""

    @property
    def kind(self) -> str:
        """First word of the name."""
        return self.name.split()[0]
