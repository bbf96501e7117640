"""Files of a session: the model with its final parameters, the filter's margin for it, and ``session.json``.

``session.json`` lists the inputs and the decisions. Replaying them restores the session after any exit.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safedpa.api.deployment import calibrate_margin_file, drive_command, refusal_reason
from safedpa.diagnosis.interactive import StepwiseModel, with_final
from safedpa.disk import why_not_written
from safedpa.dynamics import PhysicsModel, save_model
from safedpa.errors import InputError
from safedpa.limits import parse_json, readable, text_of_file
from safedpa.records.run import Run
from safedpa.records.writers.tables import atomic_path
from safedpa_services.workbench.session.inputs import EditedColumnMap, InputSelection

STEPS = (
    (0.0, "Saving: fits the final numbers along resolved recordings"),
    (0.7, "Saving: writes model.toml"),
    (0.8, "Saving: calibrates the filter's margin on the recordings"),
)
"""Steps of Save: (share at which the step starts, text shown on the page)."""


def save_model_files(
    step: bytes, runs: Sequence[Run], given: PhysicsModel, folder: Path, report_progress: Callable[[float], None]
) -> str:
    """Writes model.toml and, for robots whose margin can be calibrated from logs, margin.toml; returns a summary.

    Parameters that are free in the given model stay free; added ones are fixed at their fitted values.
    Raises InputError if the folder cannot be written to.
    """
    before: StepwiseModel = pickle.loads(step)
    final = with_final(before) if before.search.added or before.model.latent_names else before
    report_progress(0.7)
    model = _with_given_free_parameters(final.model, given)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_model(model, folder / "model.toml")
        report_progress(0.8)
        margin = calibrate_margin_file(model, runs, folder / "margin.toml")
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written to ({why_not_written(error)}); choose another folder with --out"
        ) from error
    path = folder / "model.toml"
    written = f"{path}{' and margin.toml' if margin.path else ''}"
    driven = "" if refusal_reason(model) else f": {drive_command(model, path, margin.path, period=margin.period)}"
    notice = f". {margin.notice}" if margin.notice else ""
    return f"Held-out error {final.error.value:.3g}. Written: {written}{driven}{notice}"


def _with_given_free_parameters(model: PhysicsModel, given: PhysicsModel) -> PhysicsModel:
    free = set(given.latent_names)
    return model.with_settings({path: replace(item, free=path in free) for path, item in model.settings.items()})


SESSION_FILE = "session.json"
Decision = tuple[str, str]
"""("added", "removed" or "rejected", effect)."""
_FORMAT = 1
_DECISIONS = ("added", "removed", "rejected")
_MAX_FOLDERS = 1000


@dataclass(frozen=True)
class SavedSession:
    """One session: its inputs, and its decisions in order."""

    choice: InputSelection
    decisions: tuple[Decision, ...] = ()


def read_session(path: Path) -> SavedSession:
    """Reads a session file; raises InputError that names the faulty key."""
    try:
        document = parse_json(text_of_file(path, "json_bytes"))
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); wanted the {SESSION_FILE} of a workbench"
        ) from error
    except InputError as error:
        raise InputError(f"{path}: {error}; wanted the {SESSION_FILE} of a workbench") from error
    if not isinstance(document, dict) or document.get("format") != _FORMAT:
        raise InputError(
            f"{path}: wanted a session of the workbench with format = {_FORMAT}, as it writes {SESSION_FILE}"
        )
    try:
        runs = tuple(str(run) for run in document["runs"])
        decisions = tuple((str(item["do"]), str(item["effect"])) for item in document["decisions"])
        choice = InputSelection(str(document["model"]), runs, _columns(document["columns"]), float(document["horizon"]))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {type(error).__name__} at {error}; wanted model, runs, horizon, decisions"
        ) from error
    wrong = next((do for do, _ in decisions if do not in _DECISIONS), None)
    if wrong is not None:
        raise InputError(f"{path}: decision '{readable(wrong, 40)}'; wanted {' or '.join(_DECISIONS)}")
    return SavedSession(choice, decisions)


def write_session(saved: SavedSession, folder: Path) -> None:
    """Writes session.json atomically; raises RecordingError if the folder cannot be written to."""
    columns = saved.choice.columns
    document = {
        "format": _FORMAT,
        "model": saved.choice.model,
        "runs": list(saved.choice.runs),
        "columns": {"text": columns.text, "alongside": columns.base_map}
        if isinstance(columns, EditedColumnMap)
        else columns,
        "horizon": saved.choice.horizon,
        "decisions": [{"do": do, "effect": effect} for do, effect in saved.decisions],
    }
    with atomic_path(folder / SESSION_FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _columns(entry: Any) -> str | EditedColumnMap | None:
    if entry is None or isinstance(entry, str):
        return entry
    return EditedColumnMap(str(entry["text"]), str(entry["alongside"]))


def session_folder_for(base: Path, choice: InputSelection) -> tuple[Path, tuple[Decision, ...]]:
    """Returns the folder for a session on these inputs, and the decisions saved there.

    It is the first of ``base``, ``base-2``, ... with a session on the same inputs or without any session.
    Raises InputError if all folders belong to other inputs.
    """
    wanted = absolute(choice)
    for folder in _folders(base):
        path = folder / SESSION_FILE
        if not path.is_file():
            if not (folder / "model.toml").exists():
                return folder, ()
        elif (decisions := _decisions(path, wanted)) is not None:
            return folder, decisions
    raise InputError(
        f"{base}: {_MAX_FOLDERS} sessions of other recordings exist there; choose another folder with --out"
    )


def newest_session(base: Path) -> Path | None:
    """Path of the most recently written session in ``base``, ``base-2``, ...; None if there is none."""
    found = []
    for folder in _folders(base):
        if not folder.is_dir():
            break
        found += [folder / SESSION_FILE] if (folder / SESSION_FILE).is_file() else []
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def absolute(choice: InputSelection) -> InputSelection:
    """The same inputs with absolute paths for existing files; names of shipped models and maps stay names."""

    def resolved(name: str) -> str:
        return str(Path(name).resolve()) if Path(name).is_file() else name

    columns = resolved(choice.columns) if isinstance(choice.columns, str) else choice.columns
    columns = replace(columns, base_map=resolved(columns.base_map)) if isinstance(columns, EditedColumnMap) else columns
    return replace(choice, model=resolved(choice.model), runs=tuple(map(resolved, choice.runs)), columns=columns)


def _decisions(path: Path, choice: InputSelection) -> tuple[Decision, ...] | None:
    """Decisions of the session at ``path``; None if it is unreadable or has other inputs."""
    try:
        saved = read_session(path)
    except InputError:
        return None
    return saved.decisions if saved.choice == choice else None


def _folders(base: Path) -> Iterator[Path]:
    yield base
    yield from (base.with_name(f"{base.name}-{number}") for number in range(2, _MAX_FOLDERS + 1))
