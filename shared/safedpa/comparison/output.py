"""Where results go: into new folders, or where one says, and never over what was read."""

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

__all__ = ["new_folder", "refuse_inputs", "require_writable_file", "require_writable_folder", "results_folder"]

_OF_A_BAG = ("metadata.yaml", ".mcap", ".db3", ".zstd")


def require_writable_folder(folder: Path, *, create: bool = False) -> Path:
    """The folder, made when it is not there and ``create``; asked before long work, not after it.

    Raises InputError when it is no folder or must not be written to.
    """
    try:
        if create:
            folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be made a folder ({why_not_written(error)}); choose another place with --out"
        ) from error
    if not folder.is_dir():
        raise InputError(f"{folder}: got no folder that exists; make it, or choose another place with --out")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: must not be written to; choose another place with --out")
    return folder


def require_writable_file(path: Path) -> Path:
    """The file, asked before long work: its folder is there and may be written to, and it is no folder itself.

    Raises InputError where it is not so.
    """
    require_writable_folder(path.absolute().parent)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name the file to write with --out")
    return path


@contextmanager
def results_folder(
    out: Path | None, command: str, model: str, names: Iterable[str], inputs: Iterable[str | Path], force: bool
) -> Iterator[Path]:
    """``out``, or a new folder named by command, model and time where there is none.

    It is there at once, so that no one else takes it; whatever was made goes again where the command fails before it
    wrote anything. ``names`` are the files that will be written there. Raises InputError where the folder cannot be
    written to, and where one of the files is an input, unless ``force``.
    """
    folder = new_folder(command, model) if out is None else out
    refuse_inputs([folder / name for name in names], inputs, force)
    made = [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        yield require_writable_folder(folder, create=True)
    except BaseException:
        with contextlib.suppress(OSError):  # something is in it
            for part in made:
                part.rmdir()
        raise


def new_folder(command: str, model: str, now: datetime.datetime | None = None) -> Path:
    """A folder of the current one that is not there yet: diagnose-my_car-2026-11-22-150102."""
    stamp = (now or datetime.datetime.now()).strftime("%Y-%m-%d-%H%M%S")
    name = f"{command}-{Path(model).stem}-{stamp}"
    return next(path for path in (Path(name if n == 1 else f"{name}-{n}") for n in count(1)) if not path.exists())


def refuse_inputs(outputs: Iterable[Path], inputs: Iterable[str | Path], force: bool | None = None) -> None:
    """Raises InputError where writing one of ``outputs`` would replace one of ``inputs``, unless ``force``.

    None: the command has no option --force.
    """
    read = {path.resolve() for item in inputs for path in _files_of(Path(item))}
    for path in outputs:
        if path.resolve() in read and not force:
            how = "" if force is None else ", or say --force"
            raise InputError(
                f"{path}: is an input of this command and would be replaced; choose another place with --out{how}"
            )


def _files_of(item: Path) -> list[Path]:
    """What is read of an input: the file, or of the folder of a bag its files."""
    if not item.is_dir():
        return [item] if item.exists() else []
    return [item, *(path for path in item.iterdir() if path.name.endswith(_OF_A_BAG))]
