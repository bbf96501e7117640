"""``list_effects``: the physical effects that models may have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from safedpa.dynamics import load_user_file
from safedpa.effects import AbstractEffect, effects_of, robots
from safedpa.errors import InputError, did_you_mean
from safedpa.result import AbstractResult


@final
@dataclass(frozen=True, repr=False, eq=False)
class EffectTable(AbstractResult):
    """The physical effects that models may have, by robot.

    ``by_robot`` has the effects of each robot, in the order in which they act. The table of ``to_dataframe`` has one
    row per parameter.

    Example:

        >>> table = safedpa.list_effects("pendulum")
        >>> [effect.name for effect in table.by_robot["pendulum"]][:2]
        ['torque_gain', 'torque_delay']
    """

    by_robot: dict[str, tuple[AbstractEffect, ...]]

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa effects --json`` prints."""
        return {"format": 1, "effects": [_entry(item) for items in self.by_robot.values() for item in items]}

    def _facts(self) -> dict[str, object]:
        return {robot: f"{len(items)} effects" for robot, items in self.by_robot.items()}

    def _columns(self) -> dict[str, Sequence[Any]]:
        pairs = [(item, part) for items in self.by_robot.values() for item in items for part in item.parameters]
        columns: dict[str, Sequence[Any]] = {
            "robot": [item.robot for item, _ in pairs],
            "effect": [item.name for item, _ in pairs],
            "equation": [item.equation for item, _ in pairs],
        }
        for name in ("name", "unit", "low", "high", "typical", "neutral"):
            columns["parameter" if name == "name" else name] = [getattr(part, name) for _, part in pairs]
        return columns


def list_effects(robot: str | None = None, *, effects: str | Path | None = None) -> EffectTable:
    """Lists the physical effects that a model can have, of one robot or of all.

    ``effects`` is a Python file with the user's own. Raises InputError for an unknown robot. (``safedpa.effects`` is
    the package of the effects.)

    Example:

        >>> sorted(safedpa.list_effects().by_robot)
        ['car', 'differential_drive', 'pendulum', 'point']
    """
    if effects is not None:
        load_user_file(Path(effects))
    if robot is not None and robot not in robots():
        raise InputError(f"robot: got '{robot}'; {did_you_mean(robot, robots())}")
    chosen = {owner: effects_of(owner).values() for owner in robots() if robot in (None, owner)}
    # In the order in which they act, from the command to the sensor.
    return EffectTable(
        {owner: tuple(sorted(items, key=lambda item: (item.stage, item.name))) for owner, items in chosen.items()}
    )


def _entry(item: AbstractEffect) -> dict[str, Any]:
    return {
        "robot": item.robot,
        "name": item.name,
        "stage": item.stage.name.lower(),
        "equation": item.equation,
        "parameters": [asdict(parameter) for parameter in item.parameters],
        "needs": list(item.needs),
        "signature": item.signature,
        "source": item.source,
    }
