"""``check``: whether a robot that a file declares is complete and can be filtered safely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from safedpa.check_robot import PartFinding, check_robot
from safedpa.dynamics import load_user_file
from safedpa.errors import InputError
from safedpa.result import AbstractResult
from safedpa.systems.robots import robots


@final
@dataclass(frozen=True, repr=False, eq=False)
class RobotCheck(AbstractResult):
    """What is fine, missing or wrong about the robots that a file declares.

    ``parts`` has the findings of each robot by its name: part, verdict (fine, note, missing or wrong) and sentence.

    Example:

        >>> checked = safedpa.check("incomplete.py")
        >>> checked.passed, [(part.part, part.verdict) for part in checked.parts["drone"]][-1]
        (False, ('stand_in', 'wrong'))
    """

    parts: dict[str, tuple[PartFinding, ...]]

    @property
    def passed(self) -> bool:
        """Whether every robot can be driven as it is declared."""
        return all(one.ends_well for parts in self.parts.values() for one in parts)

    def to_dict(self) -> dict[str, Any]:
        """Returns the document that ``safedpa check --json`` prints."""
        return {name: [asdict(one) for one in parts] for name, parts in self.parts.items()}

    def __str__(self) -> str:
        lines = []
        for name, parts in self.parts.items():
            lines += [f"robot '{name}'", *(f"  {one.verdict:<8}{one.part}: {one.sentence}" for one in parts)]
        return "\n".join(lines)

    def _facts(self) -> dict[str, object]:
        wrong = [f"{name} {one.part}" for name, parts in self.parts.items() for one in parts if not one.ends_well]
        return {"robots": ", ".join(self.parts), "passed": self.passed, "not_fine": ", ".join(wrong) or "nothing"}

    def _columns(self) -> dict[str, Sequence[Any]]:
        rows = [(name, one) for name, parts in self.parts.items() for one in parts]
        columns: dict[str, Sequence[Any]] = {"robot": [name for name, _ in rows]}
        return columns | {key: [getattr(one, key) for _, one in rows] for key in ("part", "verdict", "sentence")}


def check(file: str | Path, *, seed: int = 0) -> RobotCheck:
    """Checks the robots that a Python file declares: whether each is complete and can be filtered safely.

    For the test, its simulation is driven by random nominal actions from ``seed`` through its filter. Raises InputError
    if the file cannot be loaded or declares no robot.

    Example:

        >>> safedpa.check("drone.py").passed
        True
    """
    names = [name for name in load_user_file(Path(file)) if name in robots()]
    if not names:
        raise InputError(f"{file}: got no robot, wanted a class derived from AbstractRobot")
    return RobotCheck({name: tuple(check_robot(robots()[name], seed)) for name in names})
