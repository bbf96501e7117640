"""Families of policies on the car: ours at its best, and trained in the paper's world, by the same experiment.

What the paper's world is stands in the configuration that a model was trained with, and that its weights carry: a model
of another world is refused, so that no figure of this family can rest on one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, final

from safedpa.dynamics import LearnedBase
from safedpa.errors import InputError, did_you_mean
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named

_FORCE: Final = "constant_force."
_PRACTICE: Final = {"shelter": False, "loads": False, "footprint": False}
"""What the configuration's ``practice`` says of the paper's world."""


@final
@dataclass(frozen=True)
class Family:
    """Which models an experiment drives, and what their filters were calibrated on."""

    name: str
    phrase: str
    """For the page of results."""
    models: Path
    """Folder where ``safedpa train`` leaves them."""
    training: str
    """The command that makes them."""
    methods: tuple[str, ...] = ()
    """Driven when none is named; the usual ones when empty."""
    ships: bool = True
    """Whether models missing in the folder are taken from the shipped ones."""
    loads: tuple[str, ...] = ()
    """With which margins are calibrated; with those of the experiment when empty."""
    barriers: Mapping[str, float] = field(default_factory=dict)
    """Of the filter's settings, what was measured otherwise for this family."""

    def settings(self, source: str) -> FilterSettings:
        """The filter's settings from a file or by name, with the family's own numbers."""
        return settings_named(source).with_barriers(**self.barriers)

    def calibrating(self, loads: tuple[str, ...], drives: int) -> tuple[tuple[str, ...], int]:
        """The loads to calibrate with, and drives of each: as many in all as with each of the experiment's loads."""
        return (self.loads, drives * len(loads) // len(self.loads)) if self.loads else (loads, drives)

    def refuses(self, base: object) -> str:
        """Why a model's base does not belong to the family; empty when it does."""
        if self.ships:
            return ""
        if not isinstance(base, LearnedBase):
            return "is no learned one, and physics knows of loads"
        table: Mapping[str, Any] = base.weights.description.trained_on.get("configuration", {})
        reported = sorted(path for path in table.get("environment", {}) if not path.startswith(_FORCE))
        if not table or reported:
            return f"was trained with {', '.join(reported) or 'no one knows what'} in its environment"
        practice = table.get("practice", {})
        wrong = [key for key, value in _PRACTICE.items() if practice.get(key) is not value]
        if wrong:
            return f"was trained with practice.{wrong[0]} = {str(practice.get(wrong[0], True)).lower()}"
        if base.weights.has("policy") and "observation_body" not in base.weights.tensors:
            return "holds a policy that sees the footprint"
        return ""


FAMILIES: Final = {
    item.name: item
    for item in (
        Family(
            "best",
            "ours at its best: trained with loads, behind a stand-in of the filter",
            Path("learned/car"),
            "safedpa train car",
        ),
        Family(
            "paper",
            "trained in the paper's world: a drag force, no load, no footprint, no stand-in of the filter",
            Path("learned/car_paper"),
            "safedpa train car --configuration car_paper",
            methods=("safedpa", "safedpa_untuned", "rma", "rma_p", "ppo", "fix", "mix"),
            ships=False,
            loads=("none",),
            barriers={"braking_deceleration": 4.5, "braking_gain": 3.3},
        ),
    )
}
"""The braking numbers of the paper's are of the car without load: the page on the robot has the ways that they bound,
by an eighth at least, as the shipped ones bound those with every load."""


def family_named(name: str) -> Family:
    """The family of that name. Raises InputError that lists what exists."""
    if name not in FAMILIES:
        raise InputError(f"family '{name}': {did_you_mean(name, FAMILIES)}")
    return FAMILIES[name]
