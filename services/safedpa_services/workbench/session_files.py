"""What stays on the disk: the model with its final numbers, the filter's margin for it, and the session.

A session is what was opened and decided, as a small file next to what Save writes: with it the work goes on after any
end.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from safedpa.diagnosis.interactive import StepwiseModel, with_final
from safedpa.disk import why_not_written
from safedpa.dynamics import PhysicsModel, save_model
from safedpa.errors import InputError
from safedpa.limits import parse_json, readable, text_of_file
from safedpa.records.run import Run
from safedpa.records.writers.tables import atomic_path
from safedpa_services.driving import calibrate_margin_file, drive_command, refusal_reason
from safedpa_services.workbench.recordings import EditedColumnMap, InputSelection

__all__ = [
    "SESSION_FILE",
    "STEPS",
    "Decision",
    "SavedSession",
    "absolute",
    "newest_session",
    "read_session",
    "save_model_files",
    "session_folder_for",
    "write_session",
]

STEPS = (
    (0.0, "Saving: fits the final numbers along whole recordings"),
    (0.7, "Saving: writes model.toml"),
    (0.8, "Saving: calibrates the filter's margin on the recordings"),
)
"""From which share on what is done."""


def save_model_files(
    step: bytes, runs: Sequence[Run], given: PhysicsModel, folder: Path, report_progress: Callable[[float], None]
) -> str:
    """Writes model.toml, and margin.toml for a robot that a margin can be had for from logs; says what was written.

    Added parameters are fixed, those that the given file calls free stay free. Raises InputError where the folder
    cannot be written to.
    """
    before: StepwiseModel = pickle.loads(step)
    final = with_final(before) if before.search.added or before.model.latent_names else before
    report_progress(0.7)
    model = _as_given(final.model, given)
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


def _as_given(model: PhysicsModel, given: PhysicsModel) -> PhysicsModel:
    free = set(given.latent_names)
    return model.with_settings({path: replace(item, free=path in free) for path, item in model.settings.items()})


SESSION_FILE = "session.json"
Decision = tuple[str, str]
"""("added" or "rejected", effect)."""
_FORMAT = 1
_DONE = ("added", "rejected")
_MOST_FOLDERS = 1000


@dataclass(frozen=True)
class SavedSession:
    """One session: what was opened, and the decisions in their order."""

    choice: InputSelection
    decisions: tuple[Decision, ...] = ()


def read_session(path: Path) -> SavedSession:
    """Raises InputError for what is no session, naming the key."""
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
    wrong = next((do for do, _ in decisions if do not in _DONE), None)
    if wrong is not None:
        raise InputError(f"{path}: decision '{readable(wrong, 40)}'; wanted {' or '.join(_DONE)}")
    return SavedSession(choice, decisions)


def write_session(retained: SavedSession, folder: Path) -> None:
    """Writes session.json, whole or not at all. Raises RecordingError where the folder cannot be written to."""
    columns = retained.choice.columns
    document = {
        "format": _FORMAT,
        "model": retained.choice.model,
        "runs": list(retained.choice.runs),
        "columns": {"text": columns.text, "alongside": columns.alongside}
        if isinstance(columns, EditedColumnMap)
        else columns,
        "horizon": retained.choice.horizon,
        "decisions": [{"do": do, "effect": effect} for do, effect in retained.decisions],
    }
    with atomic_path(folder / SESSION_FILE) as temporary:
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _columns(reported: Any) -> str | EditedColumnMap | None:
    if reported is None or isinstance(reported, str):
        return reported
    return EditedColumnMap(str(reported["text"]), str(reported["alongside"]))


def session_folder_for(base: Path, choice: InputSelection) -> tuple[Path, tuple[Decision, ...]]:
    """The first of ``base``, ``base-2``, ... that holds the session of this choice, with what was decided in it, or
    nothing of another one."""
    wanted = absolute(choice)
    for folder in _folders(base):
        path = folder / SESSION_FILE
        if not path.is_file():
            if not (folder / "model.toml").exists():
                return folder, ()
        elif (decisions := _decisions(path, wanted)) is not None:
            return folder, decisions
    raise InputError(
        f"{base}: {_MOST_FOLDERS} sessions of other recordings lie there; choose another folder with --out"
    )


def newest_session(base: Path) -> Path | None:
    """The session that was written last in ``base``, ``base-2``, ...; None where there is none."""
    found = []
    for folder in _folders(base):
        if not folder.is_dir():
            break
        found += [folder / SESSION_FILE] if (folder / SESSION_FILE).is_file() else []
    return max(found, key=lambda path: path.stat().st_mtime, default=None)


def absolute(choice: InputSelection) -> InputSelection:
    """The same with the paths of files that exist made absolute; names that ship stay names."""

    def whole(name: str) -> str:
        return str(Path(name).resolve()) if Path(name).is_file() else name

    columns = whole(choice.columns) if isinstance(choice.columns, str) else choice.columns
    columns = replace(columns, alongside=whole(columns.alongside)) if isinstance(columns, EditedColumnMap) else columns
    return replace(choice, model=whole(choice.model), runs=tuple(map(whole, choice.runs)), columns=columns)


def _decisions(path: Path, choice: InputSelection) -> tuple[Decision, ...] | None:
    """What was decided in the session of this choice; None in that of another one."""
    try:
        retained = read_session(path)
    except InputError:
        return None
    return retained.decisions if retained.choice == choice else None


def _folders(base: Path) -> Iterator[Path]:
    yield base
    yield from (base.with_name(f"{base.name}-{number}") for number in range(2, _MOST_FOLDERS + 1))
