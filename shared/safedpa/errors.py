"""What can go wrong, as classes.

    SafedpaError
    ├── InputError            someone gave us something unusable: exit code 2, one line
    │   ├── ModelFileError    a model file: the key stands in the message
    │   ├── ColumnMapError    a column map: the key stands in the message
    │   ├── RunError          a recording: unreadable, empty, wrong columns
    │   └── MessageError      a message from the bus: wrong shape, type or not finite
    ├── MissingExtraError     something that `pip install safedpa` alone does not bring
    ├── BusError              the bus cannot be opened or a name on it is taken
    │   └── JoinError         no one lets this process in, now; it may be otherwise in a moment
    └── RecordingError        a recording could not be written (disk full, say)

Every message says what was got, what was wanted and what to do.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path
from typing import Final

__all__ = [
    "BusError",
    "ColumnMapError",
    "InputError",
    "JoinError",
    "MessageError",
    "MissingExtraError",
    "ModelFileError",
    "RecordingError",
    "RunError",
    "SafedpaError",
    "did_you_mean",
    "near_files",
]

_NAMED: Final = 60
"""Names that one reads in a sentence at most; a broad table has thousands of columns."""
_LIKE: Final = 12


class SafedpaError(Exception):
    """Root of every error that this project raises on purpose."""


class InputError(SafedpaError):
    """Bad input from a person or a file; the command line turns it into one line and exit code 2."""


class ModelFileError(InputError):
    """A model file that cannot be used."""


class ColumnMapError(InputError):
    """A column map that cannot be used."""


class RunError(InputError):
    """A recorded run that cannot be used."""


class MessageError(InputError):
    """A message from the bus that cannot be used."""


class MissingExtraError(SafedpaError):
    """Something that ``pip install safedpa`` alone does not bring; the message names the extra."""


class BusError(SafedpaError):
    """The bus cannot be opened, or a name on it is taken."""


class JoinError(BusError):
    """No one lets this process in now: no router is there, or it has no room."""


class RecordingError(SafedpaError):
    """A recording could not be written."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Sentence that lists what exists, with the nearest name first: for look-up errors.

    Of more than ``_NAMED`` names those most like ``name`` are listed, and how many there are besides.
    """
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean '{near[0]}'? " if near else ""
    if len(names) <= _NAMED:
        return f"{hint}known: {', '.join(names)}"
    like = sorted(difflib.get_close_matches(name, names, n=_LIKE, cutoff=0.0))
    return f"{hint}known: {', '.join(like)} and {len(names) - len(like)} more"


def near_files(path: Path, shipped: Iterable[str] = ()) -> str:
    """``did you mean 'drive.csv'? ``, of the files next to one that is not there and of names that ship; else empty.

    Never raises: what cannot be listed has no names.
    """
    try:
        alongside = [item.name for item in path.parent.iterdir() if item.name != path.name]
    except OSError:
        alongside = []
    near = difflib.get_close_matches(path.name, [*shipped, *alongside], n=1)
    if not near:
        return ""
    return f"did you mean '{near[0] if near[0] not in alongside else path.parent / near[0]}'? "
