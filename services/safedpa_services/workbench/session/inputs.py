"""Inputs of a session: a model, recordings and the column map with which they are read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from safedpa.comparison.comparison import with_distinct_names
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.records import ColumnMap, load_column_map, load_run
from safedpa.records.column_map.file import parse_column_map
from safedpa.records.run import Run


@dataclass(frozen=True)
class EditedColumnMap:
    """A column map that the user edited on the page."""

    text: str
    """The map as TOML."""
    base_map: str = ""
    """The map (a file or a shipped name) that supplies everything but the columns; empty if there is none."""

    @property
    def columns(self) -> ColumnMap:
        """The complete column map; raises ColumnMapError if the text is invalid."""
        edited = parse_column_map(self.text, "columns")
        return replace(load_column_map(self.base_map), columns=edited.columns) if self.base_map else edited


@dataclass(frozen=True)
class InputSelection:
    """A model (a file or a shipped name), recordings and a column map (a file, a shipped name or an edited map)."""

    model: str = ""
    runs: tuple[str, ...] = ()
    columns: str | EditedColumnMap | None = None
    horizon: float = 1.0

    @property
    def complete(self) -> bool:
        """Whether a model and at least one recording are named."""
        return bool(self.model and self.runs)

    def with_runs(self, runs: Sequence[str]) -> InputSelection:
        """The same inputs with other recordings."""
        return replace(self, runs=tuple(runs))


def load_inputs(choice: InputSelection) -> tuple[PhysicsModel, list[Run]]:
    """Loads the model and the recordings, under distinct names; raises SafedpaError if one cannot be read."""
    model = load_model(choice.model)
    columns = choice.columns.columns if isinstance(choice.columns, EditedColumnMap) else choice.columns
    columns = load_column_map(columns) if isinstance(columns, str) else columns
    runs = [load_run(path, model.system, columns) for path in choice.runs]
    return model, with_distinct_names(runs, choice.runs)
