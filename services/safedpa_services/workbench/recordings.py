"""What a page is opened on: a model, recordings, and how their columns are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safedpa.diagnosis.comparison import with_distinct_names
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.records import ColumnMap, load_column_map, load_run
from safedpa.records.run import Run

__all__ = ["Choice", "loaded"]


@dataclass(frozen=True)
class Choice:
    """A model (a file, or a name that ships), recordings, and a column map (a file, a name, or one that was made)."""

    model: str = ""
    runs: tuple[str, ...] = ()
    columns: str | ColumnMap | None = None
    horizon: float = 1.0

    @property
    def complete(self) -> bool:
        """Whether there is something to open."""
        return bool(self.model and self.runs)

    def with_runs(self, runs: Sequence[str]) -> Choice:
        """The same with other recordings."""
        return replace(self, runs=tuple(runs))


def loaded(choice: Choice) -> tuple[PhysicsModel, list[Run]]:
    """The model and its recordings, named so that they can be told apart.

    Raises InputError and its like for what cannot be read.
    """
    model = load_model(choice.model)
    columns = load_column_map(choice.columns) if isinstance(choice.columns, str) else choice.columns
    runs = [load_run(path, model.system, columns) for path in choice.runs]
    return model, with_distinct_names(runs, choice.runs)
