"""What a page is opened on: a model, recordings, and how their columns are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safedpa.comparison.comparison import with_distinct_names
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.records import ColumnMap, load_column_map, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.run import Run

__all__ = ["EditedColumnMap", "InputSelection", "load_inputs"]


@dataclass(frozen=True)
class EditedColumnMap:
    """A column map that was made in the page."""

    text: str
    """As a file would have it."""
    alongside: str = ""
    """The map (a file, or a name that ships) whose rows to skip and the like are kept; empty: none."""

    @property
    def columns(self) -> ColumnMap:
        """The map. Raises ColumnMapError."""
        made = parse_column_map(self.text, "columns")
        return replace(load_column_map(self.alongside), columns=made.columns) if self.alongside else made


@dataclass(frozen=True)
class InputSelection:
    """A model (a file, or a name that ships), recordings, and a column map (a file, a name, or one that was made)."""

    model: str = ""
    runs: tuple[str, ...] = ()
    columns: str | EditedColumnMap | None = None
    horizon: float = 1.0

    @property
    def complete(self) -> bool:
        """Whether there is something to open."""
        return bool(self.model and self.runs)

    def with_runs(self, runs: Sequence[str]) -> InputSelection:
        """The same with other recordings."""
        return replace(self, runs=tuple(runs))


def load_inputs(choice: InputSelection) -> tuple[PhysicsModel, list[Run]]:
    """The model and its recordings, named so that they can be told apart.

    Raises InputError and its like for what cannot be read.
    """
    model = load_model(choice.model)
    columns = choice.columns.columns if isinstance(choice.columns, EditedColumnMap) else choice.columns
    columns = load_column_map(columns) if isinstance(columns, str) else columns
    runs = [load_run(path, model.system, columns) for path in choice.runs]
    return model, with_distinct_names(runs, choice.runs)
