"""Output locations: a new folder or the one that the user names; inputs are never overwritten."""

from __future__ import annotations

import contextlib
import datetime
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path

from safedpa.disk import why_not_written
from safedpa.errors import InputError

# Endings of the files of a ROS bag, which is a folder.
_BAG_FILES = ("metadata.yaml", ".mcap", ".db3", ".zstd")


def require_writable_folder(folder: Path, *, create: bool = False) -> Path:
    """Checks before long work that a folder can be written to and returns it; with ``create``, creates it if missing.

    Raises InputError if it is not a folder or is not writable.
    """
    try:
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be created ({why_not_written(error)}); choose another path with --out"
        ) from error
    if not folder.is_dir():
        raise InputError(f"{folder}: is not an existing folder; create it, or choose another path with --out")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: is not writable; choose another path with --out")
    return folder


def require_writable_file(path: Path) -> Path:
    """Checks before long work that a file can be written and returns its path.

    Raises InputError if its folder does not exist or is not writable, or if the path is a folder.
    """
    require_writable_folder(path.absolute().parent)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name the file to write with --out")
    return path


@contextmanager
def results_folder(
    folder: Path, names: Iterable[str], inputs: Iterable[str | Path], force: bool, *, resumes: bool = False
) -> Iterator[Path]:
    """Yields the folder, created at once, so that no other command takes it.

    Folders that it created are removed if the command fails before it writes anything. ``names`` are the files to be
    written there. Raises InputError if the folder is not writable, or if one of the files is an input or, unless the
    command ``resumes`` it, an earlier result; ``force`` permits both.
    """
    written = [folder / name for name in names]
    refuse_inputs(written, inputs, force)
    earlier = next((path for path in written if path.exists()), None)
    # The report of another day or model may be the only record of it.
    if earlier is not None and not (force or resumes):
        raise InputError(f"{earlier}: is an earlier result; choose another folder with --out, or use --force")
    created = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        yield require_writable_folder(folder, create=True)
    except BaseException:
        with contextlib.suppress(OSError):  # rmdir refuses folders that already contain files
            for part in created:
                part.rmdir()
        raise


def new_folder(command: str, model: str, now: datetime.datetime | None = None) -> Path:
    """Returns the path of a new folder in the current one, such as diagnose-my_car-2026-11-22-150102."""
    stamp = (now or datetime.datetime.now()).strftime("%Y-%m-%d-%H%M%S")
    name = f"{command}-{Path(model).stem}-{stamp}"
    return next(path for path in (Path(name if n == 1 else f"{name}-{n}") for n in count(1)) if not path.exists())


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[str | Path], force: bool | None = None) -> None:
    """Raises InputError if writing one of ``outputs`` would replace one of ``inputs``, unless ``force``.

    ``force`` is None for commands without an option --force.
    """
    read = {path.resolve() for item in inputs for path in _files_of(Path(item))}
    for path in outputs:
        if path.resolve() in read and not force:
            how = "" if force is None else ", or use --force"
            raise InputError(
                f"{path}: is an input of this command and would be replaced; choose another path with --out{how}"
            )


def _files_of(item: Path) -> list[Path]:
    """Returns the files of an input: the file itself, or the files of a bag's folder."""
    if not item.is_dir():
        return [item] if item.exists() else []
    return [item, *(path for path in item.iterdir() if path.name.endswith(_BAG_FILES))]
